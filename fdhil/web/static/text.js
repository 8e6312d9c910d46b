// The texts of the pages in the browser's language, English by default. t("key", {name: value}) fills in {name}.

import english from "/static/text/en.js";
import {typeset} from "/static/typeset.js";

const LANGUAGES = ["en", "de", "fr"];  // to add a language, add its file next to en.js and its name here
const chosen = (navigator.languages ?? []).map((told) => told.slice(0, 2)).find((told) => LANGUAGES.includes(told)) ?? "en";
const own = chosen === "en" ? english : (await import(`/static/text/${chosen}.js`)).default;
document.documentElement.lang = chosen;

export const language = chosen;

export function t(key, values = {}) {
  const words = own[key] ?? english[key] ?? key;
  return typeset(words.replace(/\{(\w+)\}/g, (whole, name) => (name in values ? String(values[name]) : whole)));
}

// a number with significant digits, grouped by the language's rules
const TINY = 1e-6;  // smaller numbers would be all zeros

export function number(value, digits = 4) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  const notation = value !== 0 && Math.abs(value) < TINY ? "scientific" : "standard";
  return value.toLocaleString(chosen, {maximumSignificantDigits: digits, notation});
}

// a number with fixed decimals, never -0
export function decimal(value, places) {
  const shown = Number(value.toFixed(places)) + 0;
  return shown.toLocaleString(chosen, {minimumFractionDigits: places, maximumFractionDigits: places});
}

// a time in seconds since 1970 as 2026-11-23 01:25, in the time zone of the browser
export function when(seconds) {
  return new Date(seconds * 1000).toLocaleString("sv-SE", {dateStyle: "short", timeStyle: "short"});
}

export function ago(seconds) {
  if (seconds === null || seconds === undefined) return t("ago.never");
  if (seconds < 120) return t("ago.seconds", {count: Math.round(seconds)});
  if (seconds < 7200) return t("ago.minutes", {count: Math.round(seconds / 60)});
  return t("ago.hours", {count: number(seconds / 3600, 2)});
}

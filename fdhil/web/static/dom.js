// Builds elements: el("button", {type: "button", class: "act", onclick: f}, "text", child, ...). Text is never read as HTML;
// units are typeset, except in verbatim text.

import {typeset} from "/static/typeset.js";

const WORD_FOR_WORD = ["code", "pre", "option"];

export function el(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value === undefined || value === null || value === false) continue;
    if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else node.setAttribute(name, value === true ? "" : name === "aria-label" ? typeset(value) : value);
  }
  const shown = (child) => (child instanceof Node || WORD_FOR_WORD.includes(tag) ? child : typeset(String(child)));
  node.append(...children.flat(Infinity).filter((child) => child !== null && child !== undefined && child !== false).map(shown));
  return node;
}

// table({caption, head, rows, stack}): a cell is text, a node, or {text, class}; the first of a row is its header. With stack
// each row is a list of its cells on narrow screens; the roles keep it a table for screen readers.
export function table({caption, head, rows, stack = false, ...attributes}) {
  const parts = (told) => {
    const plain = told === null || told === undefined || typeof told !== "object" || told instanceof Node;
    return plain ? {text: told ?? "–", class: null} : told;
  };
  const cell = (tag, told, more) => {
    const {text, class: kind} = parts(told);
    return el(tag, {...more, class: kind}, text);
  };
  const role = (name) => (stack ? {role: name} : {});
  const names = head.map((told) => parts(told).text);
  const bodyCell = (told, k) => (k
    ? cell("td", told, {...role("cell"), "data-head": stack ? names[k] : null}) : cell("th", told, {scope: "row", ...role("rowheader")}));
  return el("div", {class: "scroll", tabindex: "0", role: "region", "aria-label": caption},
    el("table", {class: stack ? "stack" : null, ...role("table"), ...attributes},
      el("caption", {}, caption),
      el("thead", role("rowgroup"), el("tr", role("row"), head.map((told) => cell("th", told, {scope: "col", ...role("columnheader")})))),
      el("tbody", role("rowgroup"), rows.map((row) => el("tr", role("row"), row.map(bodyCell))))));
}

// a state as a word with a shape; kind is "good", "warn", "bad" or "none"
const SHAPES = {good: "●", warn: "▲", bad: "■", none: "○"};
export function lamp(kind, text) {
  return el("span", {class: `lamp ${kind}`}, el("span", {"aria-hidden": "true"}, SHAPES[kind]), ` ${text}`);
}

// a fault from the server: what happened, and the next action
export function faultBox(fault) {
  return el("div", {class: "fault", role: "alert"},
    el("strong", {}, fault.code), `: ${fault.text}`,
    fault.advice ? el("p", {class: "advice"}, fault.advice) : null);
}

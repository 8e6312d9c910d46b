// The feeds that keep a tolerance: request, progress, and the list with a button for each line.

import {el, faultBox, table} from "/static/dom.js";

const POLL_MS = 500;
const MOST = 50;

// feedsSection(told, context, goToLine) -> {node, end}
export function feedsSection(told, context, goToLine) {
  const {t, number} = context;
  const input = el("input", {
    id: "program-tolerance", type: "number", min: "0.1", step: "any", required: true, inputmode: "decimal", value: String(told.advice?.tolerance_um ?? 50),
  });
  const shown = el("div", {"aria-live": "polite"});
  const cancel = el("button", {type: "button", onclick: () => context.post(`/api/program/${told.digest}/cancel`).catch(() => null)}, t("program.cancel"));
  let timer = null, ended = false;

  async function ask(event) {
    event.preventDefault();
    clearTimeout(timer);
    try {
      const query = new URLSearchParams({tolerance_um: Number(input.value)});
      draw((await context.post(`/api/program/${told.digest}/advise?${query}`)).advice);
    } catch (fault) {
      shown.replaceChildren(faultBox(fault));
    }
  }

  async function look() {
    try {
      const now = await context.get(`/api/program/${told.digest}`);
      if (!ended) draw(now.advice);
    } catch (fault) {
      shown.replaceChildren(faultBox(fault));
    }
  }

  function draw(advice) {
    if (!advice) return;
    const values = {tolerance: number(advice.tolerance_um, 4), trial: advice.trial ?? 0};
    if (["waiting", "computing"].includes(advice.state)) {
      shown.replaceChildren(el("p", {}, t("program.feeds.computing", values)), cancel);
      timer = setTimeout(look, POLL_MS);
    } else if (advice.state === "failed") shown.replaceChildren(faultBox(advice.fault));
    else if (advice.state === "cancelled") shown.replaceChildren(el("p", {}, t("program.feeds.cancelled")));
    else if (!advice.lines.length) shown.replaceChildren(el("p", {}, t("program.feeds.none", values)));
    else shown.replaceChildren(list(advice, values));
  }

  function list(advice, values) {
    const worst = [...advice.lines].sort((a, b) => b.error_um - a.error_um).slice(0, MOST).sort((a, b) => a.start_s - b.start_s);
    const feed = (value) => (value === null ? t("program.feeds.no") : number(Math.floor(value), 6));
    const place = (each) => (each.line ? el("button", {
      type: "button", "aria-label": t("program.places.show.label", each), onclick: () => goToLine(each.line),
    }, String(each.line)) : `${each.start_s.toFixed(2)} s`);
    const word = (key) => ({text: t(key), class: "word"});
    return el("div", {}, table({
      caption: t("program.feeds.caption", values),
      head: [t("program.places.line"), word("program.places.cause"), t("program.places.before"), t("program.feeds.programmed"),
        t("program.feeds.advised"), t("program.feeds.corrected")],
      rows: worst.map((each) => [place(each), {text: each.cause, class: "word"}, number(each.error_um, 3), feed(each.feed_mm_min),
        each.advised_feed_mm_min === null ? feed(null) : feed(each.run_feed_mm_min),
        each.corrected_run_feed_mm_min === null ? "–" : each.corrected_feed_mm_min === null ? feed(null) : feed(each.corrected_run_feed_mm_min)]),
    }), advice.lines.length > worst.length ? el("p", {}, t("program.feeds.more", {count: advice.lines.length - worst.length})) : null);
  }

  draw(told.advice);
  const node = el("section", {"aria-labelledby": "feeds-title"},
    el("h2", {id: "feeds-title"}, t("program.feeds")),
    el("form", {class: "tools", onsubmit: ask},
      el("label", {for: "program-tolerance"}, t("program.feeds.tolerance"), el("br"), input),
      el("button", {type: "submit"}, t("program.feeds.ask"))), shown);
  return {node, end() { ended = true; clearTimeout(timer); }};
}

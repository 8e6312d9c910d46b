// The black boxes: their list, downloads, and the drives' signals.

import {chart} from "/static/chart.js";
import {el, faultBox, table} from "/static/dom.js";
import {minute} from "/static/notices.js";
import {number, t} from "/static/text.js";

export async function boxesSection(context) {
  const boxes = await context.get("/api/events/black-boxes");
  const place = el("div", {"aria-live": "polite"});
  let charts = [];
  const end = () => { charts.forEach((each) => each.end()); charts = []; };

  async function open(box) {
    end();
    place.replaceChildren(el("p", {class: "soft"}, t("events.boxes.loading")));
    try {
      const told = await context.get(`/api/events/black-boxes/${encodeURIComponent(box.name)}`);
      place.replaceChildren(el("h3", {tabindex: "-1", id: "black-box"}, t("events.box.title", {time: minute(box.time)})));
      if (!told.axes.length) place.append(el("p", {}, t("events.box.none")));
      for (const axis of told.axes) charts.push(...drawAxis(place, axis));
      document.getElementById("black-box").focus();
    } catch (fault) {
      place.replaceChildren(faultBox(fault));
    }
  }

  const button = (key, box, onclick) => el("button", {type: "button", onclick, "aria-label": t(`${key}.one`, box)}, t(key));
  const list = boxes.length ? table({
    caption: t("events.boxes.caption"),
    head: [t("events.time"), {text: t("events.boxes.trip"), class: "word"}, t("events.boxes.size"), {text: t("events.boxes.act"), class: "word"}],
    rows: boxes.map((box) => [minute(box.time), {text: box.code, class: "word"}, number(box.size_bytes / 1024, 3), el("span", {class: "actions"},
      button("events.boxes.show", box, () => open(box)),
      button("events.boxes.download", box, () => context.download(`/api/events/black-boxes/${encodeURIComponent(box.name)}/file`, box.name)
        .catch((fault) => place.replaceChildren(faultBox(fault)))))]),
  }) : el("p", {}, t("events.boxes.none"));
  const section = el("section", {"aria-labelledby": "events-boxes"},
    el("h2", {id: "events-boxes"}, t("events.boxes")), el("p", {class: "soft"}, t("events.boxes.intro")), list, place);
  return {section, end};
}

function drawAxis(place, axis) {
  place.append(el("h4", {}, t("events.box.axis", {axis: axis.axis, samples: axis.samples, lost: axis.lost_frames})));
  const grid = place.appendChild(el("div", {class: "grid"}));
  const name = (signal) => t(`events.signal.${signal.name}`);
  const charts = axis.signals.map((signal) => {
    const shown = chart(grid, {
      caption: name(signal), unit: signal.unit, height: 160, sync: `black-box-${axis.axis}`,
      series: [{label: name(signal), colour: 1, band: true}], x: {label: t("events.box.time"), unit: "s"},
    });
    shown.set(axis.time_s, [{low: signal.low, high: signal.high}]);
    return shown;
  });
  const ends = (values, pick) => { const known = values.filter((value) => value !== null); return known.length ? pick(...known) : null; };
  place.append(table({
    caption: t("events.box.extremes", axis), head: [t("events.box.signal"), t("events.box.low"), t("events.box.high")],
    rows: axis.signals.map((signal) => [name(signal), `${number(ends(signal.low, Math.min))} ${signal.unit}`, `${number(ends(signal.high, Math.max))} ${signal.unit}`]),
  }));
  return charts;
}

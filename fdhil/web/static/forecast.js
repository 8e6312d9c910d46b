// A program's forecast: figures, two maps with one scale and one camera, worst zones, curve over time, text.

import {chart} from "/static/chart.js";
import {el, faultBox, table} from "/static/dom.js";
import {feedsSection} from "/static/feeds.js";
import {makeCamera, pathMap, shadeKey, zoomStep} from "/static/path.js";

const FACTORS = [0, 1, 10, 100, 1000];  // 0: as far as the view has room
const ASK_MS = 150;
const CASES = ["before", "after"];
const LINES_AROUND = 7;
const LEAST_UM = 0.001;  // below any drive's resolution
const MOST_NEAR_MM = 5;  // to each side of a shown zone; less in a small section

// ``next`` is shown after the figures
export async function showForecast(shown, told, query, context, next) {
  const {t, get} = context;
  const forecast = told.forecast;
  const base = `/api/program/${told.digest}`;
  const method = forecast.method;
  const cases = forecast.refused.length ? ["before"] : CASES;
  const state = {plane: forecast.planes[0], factor: 0, whole: null, part: null, cursor: null};

  const camera = makeCamera();
  const hint = el("p", {class: "soft", id: "map-hint"}, t("program.map.hint"));
  const tableWords = el("p", {class: "soft"});
  const readout = el("dl", {class: "readout"});
  const live = el("p", {class: "hidden", "aria-live": "polite"});
  const listing = el("ol", {class: "listing"});
  const lineFault = el("div", {"aria-live": "polite"});

  const maps = cases.map((which, k) => pathMap({
    camera, hint: "map-hint", values: `${which}_um`, table: k, scale: forecast.scale,
    label: t("program.map.label", {
      plane: state.plane.join(" "), which: t(`program.${which}`, {method}), max: context.number(forecast[which].max_um, 3),
    }),
    onCursor: ({run, k: at}) => pointAt(ofRun(run, at)), onStep: step,
  }));

  const planeChoice = forecast.planes.length > 1 ? choice("plane", t("program.plane"), forecast.planes.map((p) => p.join(" ")), 0,
    async (k) => { state.plane = forecast.planes[k]; await fetchWhole(); fit(); mark(); }) : null;
  const factorChoice = choice("factor", t("program.factor"), FACTORS.map((factor) => (factor ? t("program.factor.times", {factor}) : t("program.factor.fit"))),
    FACTORS.indexOf(state.factor), (k) => { state.factor = FACTORS[k]; fetchPart(); });
  const button = (key, f) => el("button", {type: "button", onclick: f}, t(key));

  const feeds = feedsSection(told, context, (line) => goToLine(line));
  shown.replaceChildren(
    figures(told, context), next,
    el("section", {"aria-labelledby": "map-title"},
      el("h2", {id: "map-title"}, t("program.map")),
      el("div", {class: "tools"},
        button("program.zoom.in", () => step("in")), button("program.zoom.out", () => step("out")), button("program.zoom.whole", fit),
        planeChoice, factorChoice),
      el("div", {class: "maps"}, maps.map((map, k) => el("figure", {}, el("figcaption", {}, t(`program.map.${cases[k]}`, {method})), map.node))),
      el("p", {class: "soft"}, t("program.map.key")), shadeKey(forecast.scale, {title: t("program.map.key"), text: shadeText}),
      tableWords, hint,
      el("h3", {}, t("program.cursor")), readout, live),
    places(),
    feeds.node,
    courseSection(),
    forecast.has_lines ? el("section", {"aria-labelledby": "text-title"},
      el("h2", {id: "text-title"}, t("program.listing")), lineForm(), lineFault, listing) : null);

  function shadeText(from, to) {
    const short = (um) => context.number(um, 2);
    if (from === 0) return t("program.map.shade.first", {to: short(to)});
    return to === null ? t("program.map.shade.last", {from: short(from)}) : t("program.map.shade", {from: short(from), to: short(to)});
  }

  function choice(name, label, words, chosen, f) {
    const select = el("select", {id: `program-${name}`, onchange: () => f(select.selectedIndex)},
      words.map((word, k) => el("option", {selected: k === chosen}, word)));
    return el("label", {for: `program-${name}`}, label, select);
  }

  const draw = () => maps.forEach((map) => map.show(state.part ?? state.whole, state.plane));
  const inPlane = (at) => [at[forecast.axes.indexOf(state.plane[0])],
    state.plane[0] === state.plane[1] ? 0 : at[forecast.axes.indexOf(state.plane[1])]];

  async function fetchWhole() {
    const [across, along] = state.plane;
    state.part = null;
    state.whole = await get(`${base}/view?${new URLSearchParams({across, along})}`);
    draw();
  }

  function box() {
    const [wide, tall] = maps[0].size();
    const [x, y] = [wide * camera.scale / 2, tall * camera.scale / 2];
    return {left: camera.x - x, right: camera.x + x, bottom: camera.y - y, top: camera.y + y};
  }

  let timer = null, asked = null;
  function later() {
    clearTimeout(timer);
    timer = setTimeout(fetchPart, ASK_MS);
  }
  async function fetchPart() {
    asked?.abort();
    asked = new AbortController();
    const [across, along] = state.plane;
    if (camera.scale >= camera.widest * 0.95 && !state.whole?.whole) { state.part = null; tellTable(); draw(); return; }
    try {
      const place = new URLSearchParams({across, along, factor: state.factor, ...box()});
      state.part = await get(`${base}/view?${place}`, {signal: asked.signal});
      tellTable();
      draw();
    } catch (fault) {
      if (fault.name !== "AbortError") context.say(`${fault.text}. ${fault.advice}`);
    }
  }
  const tellTable = () => {
    tableWords.textContent = state.part?.whole ? t("program.table", {factor: state.part.factor}) : t("program.table.none");
  };

  // show the whole path
  function fit() {
    const [across, along] = state.plane.map((axis) => forecast.moved[axis]);
    const flat = state.plane[0] === state.plane[1] ? [0, 0] : along;
    const [wide, tall] = maps[0].size();
    camera.widest = 1.15 * Math.max((across[1] - across[0]) / wide, (flat[1] - flat[0]) / tall, 1e-5);
    camera.set((across[0] + across[1]) / 2, (flat[0] + flat[1]) / 2, camera.widest);
  }

  // show a zone and its surroundings, its error enlarged as needed
  const size = Math.max(...Object.values(forecast.moved).map(([low, high]) => high - low));
  function goTo(at, um) {
    const [x, y] = inPlane(at);
    const half = Math.max(MOST_NEAR_MM * Math.min(1, Math.max(0.2, size / 100)), 0.02 * um);
    camera.set(x, y, 2 * half / Math.min(...maps[0].size()));
  }

  function ofRun(run, k) {
    return {
      row: run.row[k], line: run.line[k], x: run.x_mm[k], y: run.y_mm[k],
      before_um: run.before_um[k], after_um: run.after_um[k], feed_mm_min: run.feed_mm_min[k],
    };
  }

  let quiet = null;
  function pointAt(at, jump = false) {
    state.cursor = at;
    maps.forEach((map) => map.point(at));
    const entries = [
      [state.plane[0], `${at.x.toFixed(3)} mm`], ...(state.plane[0] === state.plane[1] ? [] : [[state.plane[1], `${at.y.toFixed(3)} mm`]]),
      [t("program.cursor.line"), at.line || "–"], [t("program.cursor.time"), `${(at.row * forecast.sync_period_s).toFixed(3)} s`],
      [t("program.cursor.feed"), `${context.number(at.feed_mm_min, 5)} mm/min`],
      [t("program.cursor.before"), `${context.number(at.before_um, 3)} µm`],
      ...(cases.length > 1 ? [[t("program.cursor.after"), `${context.number(at.after_um, 3)} µm`]] : [])];
    readout.replaceChildren(...entries.map(([name, value]) => el("div", {}, el("dt", {}, name), el("dd", {}, String(value)))));
    if (jump) goTo(jump, at.before_um);
    clearTimeout(quiet);
    quiet = setTimeout(() => {
      live.textContent = entries.map(([name, value]) => `${name} ${value}`).join(", ");
      listAround(at.line);
      if (at.line) history.replaceState({}, "", `/program/${told.digest}?line=${at.line}`);
    }, 250);
  }

  // keys: along the path, to the lines before and after, nearer and farther
  function step(key) {
    if (key === "whole") return fit();
    if (key === "in" || key === "out") {
      const at = state.cursor && inView(state.cursor) ? [state.cursor.x, state.cursor.y] : [];
      return camera.zoom(key === "in" ? zoomStep : 1 / zoomStep, ...at);
    }
    if (key === "ArrowUp" || key === "ArrowDown") return goToLine(nextLine(key === "ArrowDown" ? 1 : -1), true);
    const points = (state.part ?? state.whole).runs.flatMap((run) => run.row.map((_, k) => [run, k]));
    if (!points.length) return null;
    const row = state.cursor?.row ?? -1;
    const later = points.findIndex(([run, k]) => run.row[k] > row);
    const at = key === "ArrowRight" ? (later < 0 ? points.length - 1 : later)
      : Math.max(0, points.findLastIndex(([run, k]) => run.row[k] < row));
    const found = ofRun(...points[at]);
    pointAt(found);
    if (!inView(found)) camera.set(found.x, found.y, camera.scale);
    return null;
  }
  function inView({x, y}) {
    const {left, right, bottom, top} = box();
    return x >= left && x <= right && y >= bottom && y <= top;
  }
  const lines = [...new Set(forecast.zones.map((zone) => zone.line))];
  function nextLine(way) {
    const line = state.cursor?.line ?? 0;
    return Math.max(1, line + way) || lines[0];
  }

  async function goToLine(line, stay = false) {
    try {
      const found = await get(`${base}/line/${line}`);
      const [x, y] = inPlane(found.at_mm);
      lineFault.replaceChildren();
      pointAt({...found, x, y}, stay ? false : found.at_mm);
      if (stay && !inView({x, y})) camera.set(x, y, camera.scale);
    } catch (fault) {
      lineFault.replaceChildren(el("p", {}, fault.status === 404 ? t("program.listing.still", {line}) : fault.text));
      listAround(line);
    }
  }

  function places() {
    const rows = forecast.zones.map((zone) => [
      el("button", {type: "button", "aria-label": t("program.places.show.label", zone), onclick: () => showZone(zone)},
        zone.place ? t("program.places.show.place", zone) : t("program.places.show")),
      zone.line || "–", {text: zone.where, class: "word"}, {text: zone.cause, class: "word"},
      `${zone.start_s.toFixed(2)} – ${zone.end_s.toFixed(2)}`, context.number(zone.feed_mm_min, 5), context.number(zone.before_um, 3),
      ...(cases.length > 1 ? [context.number(zone.after_um, 3)] : [])]);
    const more = forecast.zones_in_all - forecast.zones.length;
    const word = (key) => ({text: t(key), class: "word"});
    return el("section", {"aria-labelledby": "places-title"},
      el("h2", {id: "places-title"}, t("program.places")),
      rows.length ? table({
        caption: t("program.places.caption"), rows,
        head: [t("program.places.place"), t("program.places.line"), word("program.places.where"), word("program.places.cause"),
          t("program.places.time"), t("program.places.feed"), t("program.places.before"), ...(cases.length > 1 ? [t("program.places.after")] : [])],
      }) : el("p", {}, t("program.places.none")),
      more > 0 ? el("p", {}, t("program.places.more", {count: more})) : null);
  }

  function showZone(zone) {
    const [x, y] = inPlane(zone.at_mm);
    pointAt({...zone, x, y, feed_mm_min: zone.feed_mm_min}, zone.at_mm);
    maps[0].node.scrollIntoView({block: "nearest"});
    maps[0].node.focus({preventScroll: true});
  }

  function mark() {
    const marked = forecast.zones.filter((zone) => zone.place).map((zone) => {
      const [x, y] = inPlane(zone.at_mm);
      return {number: zone.place, x, y};
    });
    maps.forEach((map) => map.mark(marked));
  }

  function lineForm() {
    const input = el("input", {id: "program-line", type: "number", min: "1", required: true, inputmode: "numeric"});
    return el("form", {class: "tools", onsubmit: (event) => { event.preventDefault(); goToLine(Number(input.value)); }},
      el("label", {for: "program-line"}, t("program.listing.jump"), el("br"), input),
      el("button", {type: "submit"}, t("program.listing.go")));
  }

  let listed = null;
  async function listAround(line) {
    if (!forecast.has_lines || !line || listed === line) return;
    listed = line;
    const first = Math.max(1, line - LINES_AROUND);
    const text = await get(`${base}/text?first=${first}&count=${2 * LINES_AROUND + 1}`).catch(() => null);
    if (!text || listed !== line) return;
    listing.replaceChildren(...text.lines.map((each) => el("li", {}, el("button", {
      type: "button", "aria-current": each.line === line ? "true" : null, onclick: () => goToLine(each.line),
    }, el("span", {}, String(each.line)), el("span", {}, each.text || " ")))));
  }

  // contour errors and feed over time; a zoomed section is requested again at full resolution
  let charts = [];
  function courseSection() {
    const place = el("div", {});
    const made = (caption, unit, colour) => chart(place, {
      caption, unit, series: [{label: caption, colour}], sync: "program", zero: true, height: 150,
      x: {label: t("program.course.time"), unit: "s"}, onZoom: fetchCourse, onCursor: (at) => at !== null && pointNear(at / forecast.sync_period_s),
    });
    queueMicrotask(() => {  // a chart needs the width of its element
      charts = [
        ...cases.map((which, k) => made(t(`program.map.${which}`, {method}), "µm", k ? 1 : 2)),
        made(t("program.cursor.feed"), "mm/min", 3)];
      fetchCourse(null);
    });
    async function fetchCourse(stretch) {
      const query = stretch ? `?${new URLSearchParams({start_s: Math.max(0, stretch.from), end_s: Math.max(0, stretch.to)})}` : "";
      try {
        const course = await get(`${base}/course${query}`);
        const values = [...cases.map((which) => course[`${which}_um`]), course.feed_mm_min];
        charts.forEach((each, k) => each.set(course.time_s, [values[k]]));
      } catch (fault) {
        place.replaceChildren(faultBox(fault));
      }
    }
    return el("section", {"aria-labelledby": "course-title"},
      el("h2", {id: "course-title"}, t("program.course")), el("p", {class: "soft"}, t("program.course.text")), place);
  }
  function pointNear(row) {
    const points = (state.whole?.runs ?? []).flatMap((run) => run.row.map((at, k) => [Math.abs(at - row), run, k]));
    if (!points.length) return;
    const [, run, k] = points.reduce((best, each) => (each[0] < best[0] ? each : best));
    if (state.cursor?.row !== run.row[k]) pointAt(ofRun(run, k));
  }

  camera.onChange(later);
  readout.append(el("div", {}, el("dt", {}, t("program.cursor.none")), el("dd", {}, "–")));
  await fetchWhole();
  fit();
  mark();
  tellTable();
  const line = Number(query.get("line"));
  if (line > 0) await goToLine(line);
  else listAround(forecast.zones[0]?.line || 1);
  return () => { clearTimeout(timer); clearTimeout(quiet); asked?.abort(); feeds.end(); maps.forEach((map) => map.end()); charts.forEach((each) => each.end()); };
}

function figures(told, context) {
  const {t, ago} = context;
  const number = (value, digits) => (value < LEAST_UM ? `< ${LEAST_UM}` : context.number(value, digits));
  const forecast = told.forecast;
  const {before, after, refused} = forecast;
  const half = after.uncertainty_um;
  const left = half === null ? number(after.rms_um, 3) : t("program.uncertain", {rms: number(after.rms_um, 3), most: number(after.rms_um + half, 2)});
  const rows = [[t("program.before"), number(before.rms_um, 3), number(before.max_um, 3)]];
  if (!refused.length) rows.push([t("program.after", forecast), left, number(after.max_um, 3)]);
  const sure = half === null ? t("program.gain.model") : forecast.gain_at_least === null ? t("program.gain.unsure")
    : t("program.gain", {factor: number(forecast.gain_at_least, 3)});
  const known = Object.entries(forecast.parameters).map(([axis, {revision, age_s: age}]) => (revision
    ? t("program.parameters.identified", {axis, revision, age: ago(age)}) : t("program.parameters.nominal", {axis})));
  return el("section", {"aria-labelledby": "figures-title"},
    el("h2", {id: "figures-title"}, told.name),
    ...refused.map((reason) => faultBox({...reason, text: t("program.refused", reason)})),
    table({
      stack: true, caption: t("program.figures", {duration: number(forecast.duration_s, 4)}),
      head: [t("program.case"), t("program.rms"), t("program.largest")], rows,
    }),
    refused.length ? null : el("p", {}, sure),
    el("p", {}, t("program.parameters", {text: known.join("; ")})),
    Object.values(forecast.seen_at).includes("encoder") ? el("p", {class: "soft"}, t("program.encoder")) : null,
    ...forecast.warnings.map((reason) => el("p", {}, el("strong", {}, reason.code), ": ", t("program.warning", {text: `${reason.text}; ${reason.advice}`}))));
}

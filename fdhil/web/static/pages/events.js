// Alarms with cause, effect and next action, unacknowledged ones first; black boxes: /events?axis=X&code=C&severity=S.

import {boxesSection} from "/static/black_boxes.js";
import {el, faultBox, lamp} from "/static/dom.js";
import {answered, classOf, classWords, dress, gravity, minute, noticeList, noticeText, sentence, where} from "/static/notices.js";
import {session} from "/static/session.js";
import {t} from "/static/text.js";

const FILTERS = ["axis", "code", "severity"];

export async function show(main, path, context) {
  dress();
  const place = main.appendChild(el("div"));  // answers that arrive after a page change are ignored
  const only = Object.fromEntries(FILTERS.map((name) => [name, path.query.get(name)]).filter(([, value]) => value));
  const wanted = new URLSearchParams(only);
  let told = await context.get(`/api/events?${wanted}`);
  const count = el("p", {"aria-live": "polite"});
  const waiting = el("div");
  const others = el("div");
  const boxes = await boxesSection(context);
  place.append(
    el("h1", {}, t("events.title")), el("p", {class: "soft"}, t("events.intro")), filter(told, only, context),
    el("section", {"aria-labelledby": "events-waiting"}, el("h2", {id: "events-waiting"}, t("events.waiting")), count, waiting),
    el("section", {"aria-labelledby": "events-others"}, el("h2", {id: "events-others"}, t("events.others")), others),
    boxes.section);
  draw();
  let mark = null;
  const unwatch = context.watch(({status, fault}) => {
    if (fault || !status.unacknowledged) return;
    const now = JSON.stringify([status.unacknowledged.count, status.unacknowledged.newest.at(-1)?.number, status.alarms?.active, status.notices.at(-1)?.number]);
    if (mark !== null && now !== mark) again();
    mark = now;
  });
  return () => { unwatch(); boxes.end(); };

  async function again() {
    told = await context.get(`/api/events?${wanted}`).catch(() => told);
    draw();
  }

  function draw() {
    const {active_count: active, waiting_count: waits, waiting_major: major} = told;
    count.textContent = told.waiting.length ? t("events.count", {active, waits, major}) : t("events.none");
    waiting.replaceChildren(...(told.waiting.length ? [
      actAll(), el("ul", {class: "plain"}, told.waiting.map((alarm) => el("li", {}, card(alarm)))),
    ] : []));
    others.replaceChildren(told.others.length ? noticeList(told.others) : el("p", {}, t("events.others.none")),
      told.older_before ? el("p", {}, el("button", {type: "button", onclick: older}, t("events.older"))) : "");
  }

  async function older() {
    const page = await context.get(`/api/events?${new URLSearchParams({...only, before: told.older_before})}`);
    told = {...told, others: [...told.others, ...page.others], older_before: page.older_before};
    draw();
  }

  function actAll() {
    if (!session().acting) return el("p", {class: "soft"}, t("events.acknowledge.login"));
    if (Object.keys(only).length || told.waiting_count < 2) return "";
    const about = t("events.acknowledge.ask.all", {count: told.waiting_count, number: told.newest_waiting});
    return el("p", {}, el("button", {
      type: "button", onclick: () => askToAcknowledge(about, {up_to: told.newest_waiting}, context).then((done) => done && again()),
    }, t("events.acknowledge.all", {count: told.waiting_count})));
  }

  function card({newest, state, until, count: times, numbers, first_time: first, earlier}) {
    const about = t(numbers.length > 1 ? "events.acknowledge.ask.kind" : "events.acknowledge.ask.one", {...newest, count: numbers.length});
    const act = () => askToAcknowledge(about, {notices: numbers}, context).then((done) => done && again());
    const active = state === "active", since = minute(newest.time), ended = until ? minute(until) : null;
    const span = active ? t("events.since", {from: since}) : ended === since ? since : t("events.from.until", {from: since, until: ended});
    const often = times > 1 ? t("events.times", {count: times, first: minute(first)}) : "";
    const said = el("dl", {class: "said"}, [["events.effect", newest.effect], ["events.next", newest.action]].filter(([, text]) => text)
      .map(([key, text]) => [el("dt", {}, t(key)), el("dd", {}, sentence(text))]));
    const list = earlier.length ? el("ul", {}, earlier.map((told) => el("li", {}, `${minute(told.time)} (${told.number}): ${told.text}`))) : null;
    const more = el("details", {}, el("summary", {}, list ? t("events.earlier", {count: times - 1}) : t("events.more")), active ? null : said, list);
    return el("article", {class: state, "aria-labelledby": `notice-${newest.number}`},
      el("div", {},
        el("h3", {id: `notice-${newest.number}`}, noticeText(newest)),
        el("p", {}, lamp(active ? {MAJOR: "bad", minor: "warn"}[newest.severity] : "none", t(`events.state.${state}`)), ` ${span}. ${often} `,
          el("span", {class: "soft"}, gravity(newest), ` ${where(newest)}, ${t("events.number")} ${newest.number}. `, classOf(newest), " ", numbers.length ? "" : answered(newest))),
        active ? said : null, active && !list ? null : more),
      numbers.length && session().acting ? el("button", {
        type: "button", onclick: act, "aria-label": t("events.acknowledge.one", {...newest, code: classWords(newest.code)}),
      }, t("events.acknowledge")) : null);
  }
}

function filter(told, only, context) {
  const choices = {
    axis: [...new Set([...told.waiting.map(({newest}) => newest), ...told.others].map((notice) => notice.axis).filter(Boolean).concat(only.axis ?? []))].sort(),
    code: told.codes, severity: ["MAJOR", "minor", "info"],
  };
  const selects = FILTERS.map((name) => el("span", {},
    el("label", {for: `filter-${name}`}, t(`events.filter.${name}`)),
    el("select", {id: `filter-${name}`, name, onchange: change},
      el("option", {value: ""}, t(name === "severity" ? "events.filter.grave" : "events.filter.any")),
      choices[name].map((value) => el("option", {value, selected: value === only[name]}, name === "severity" ? t(`events.${value}`) : name === "code" ? classWords(value) : value)))));
  function change(event) {
    const next = {...only, [event.target.name]: event.target.value};
    const query = new URLSearchParams(Object.entries(next).filter(([, value]) => value));
    context.go(`/events${query.size ? `?${query}` : ""}`).then(() => document.getElementById(event.target.id)?.focus());
  }
  return el("form", {class: "choices", "aria-label": t("events.filter"), onsubmit: (event) => event.preventDefault()}, selects);
}

// resolves to true once the daemon has stored it
function askToAcknowledge(about, which, context) {
  return new Promise((resolve) => {
    const note = el("input", {id: "acknowledge-note", maxlength: "200", autocomplete: "off"});
    const refused = el("div", {"aria-live": "assertive"});
    let done = false;
    const dialog = el("dialog", {"aria-labelledby": "acknowledge-title"},
      el("form", {method: "dialog", onsubmit: submit},
        el("h2", {id: "acknowledge-title"}, t("events.acknowledge.title")),
        el("p", {}, about), el("p", {}, t("events.acknowledge.ask")),
        el("label", {for: "acknowledge-note"}, t("events.acknowledge.note")), note, refused,
        el("p", {class: "actions"},
          el("button", {type: "submit", class: "primary"}, t("events.acknowledge")),
          el("button", {type: "button", onclick: () => dialog.close()}, t("events.acknowledge.cancel")))));
    async function submit(event) {
      event.preventDefault();
      try {
        const answer = await context.post("/api/events/acknowledge", {...which, note: note.value});
        context.say(answer.text);
        done = true;
        dialog.close();
      } catch (fault) {
        refused.replaceChildren(faultBox(fault));
      }
    }
    dialog.addEventListener("close", () => { dialog.remove(); resolve(done); });
    document.body.append(dialog);
    dialog.showModal();
    note.focus();
  });
}

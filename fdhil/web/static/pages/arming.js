// Arming: choose a program, see its predicted error and what it may move, confirm. Disarming needs no confirmation; its button is
// in the head of every page.

import {el, faultBox, table} from "/static/dom.js";

const POLL_MS = 400;
const FORECAST_METHOD = "inverse";
const UNSET = "-";

// ``only``: {name, digest} of the only program that may be armed there; otherwise it is chosen in the dialog
export function armingPanel(context, only = null) {
  const {t, session} = context;
  const open = el("button", {type: "button", class: "primary", id: "arm", onclick: () => choose(context, only)}, t("arm.open"));
  const why = el("p", {class: "soft"});
  const node = el("div", {class: "actions"}, open, why);
  function update(status, fault) {
    const {role, acting, login_needed: needed} = session();
    const reason = !needed ? "arm.no.users" : role !== "operate" ? "arm.no.role" : !acting ? "arm.no.acting"
      : fault || !status ? "arm.no.daemon" : status.state === "OFF(SHADOW)" ? "arm.no.guard" : status.armed ? "arm.no.armed" : "";
    open.disabled = Boolean(reason);
    why.textContent = reason ? t(reason) : "";
  }
  update(null, null);
  return {node, update, end: () => document.getElementById("arming")?.close()};
}

async function choose(context, only) {
  const {t} = context;
  let choice;
  try {
    choice = await context.get("/api/machine/programs");
  } catch (fault) {
    context.say(`${fault.code}: ${fault.text}`);
    return;
  }
  const unset = () => el("option", {value: UNSET, selected: true, disabled: true}, t("arm.choose"));
  const names = choice.programs.map(({name}) => name).filter((name) => only === null || name === only.name);
  const program = el("select", {id: "arm-program", onchange: () => look()}, only === null ? unset() : null,
    names.map((name) => el("option", {value: name}, name)),
    choice.feedforward && only === null ? el("option", {value: ""}, t("arm.program.none")) : null);
  const method = el("select", {id: "arm-method", onchange: () => look()}, unset(),
    choice.methods.map((name) => el("option", {value: name}, t(`method.${name}`))));
  const shown = el("div", {"aria-live": "polite", id: "arm-plan"});
  const predicted = el("p", {"aria-live": "polite", id: "arm-predicted"});
  const told = el("div", {"aria-live": "assertive"});
  const confirm = el("button", {type: "submit", class: "primary", disabled: true}, t("arm.confirm"));
  // the dialog covers the head of the page with the Disarm button, which must always be visible
  const disarm = el("button", {type: "button", class: "stop", onclick: context.disarm}, t("disarm"));
  const dialog = el("dialog", {id: "arming", "aria-labelledby": "arm-title"}, el("form", {method: "dialog", onsubmit: act},
    el("h2", {id: "arm-title"}, t("arm.title")),
    el("label", {for: "arm-program"}, t("arm.program")), program,
    program.options.length > (only === null) ? null : el("p", {}, only ? t("arm.program.elsewhere", only) : t("arm.programs.none")),
    el("label", {for: "arm-method"}, t("arm.method")), method, shown, predicted, told,
    el("p", {class: "actions"}, confirm, el("button", {type: "button", onclick: () => dialog.close()}, t("arm.cancel")), disarm)));
  let plan = null;
  let turn = 0;
  const stopping = new AbortController();

  async function look() {
    const mine = ++turn;
    plan = null;
    confirm.disabled = true;
    told.replaceChildren();
    predicted.textContent = "";
    if ([program.value, method.value].includes(UNSET) || only && !names.length) return;
    const query = new URLSearchParams({method: method.value, ...(program.value ? {program: program.value} : {})});
    const found = await context.get(`/api/machine/plan?${query}`).catch((fault) => ({fault}));
    if (mine !== turn) return;
    if (found.fault) { shown.replaceChildren(faultBox(found.fault)); return; }
    if (only && found.program?.sha256 !== only.digest) { shown.replaceChildren(el("p", {class: "fault"}, t("arm.program.elsewhere", only))); return; }
    plan = found;
    confirm.disabled = false;
    shown.replaceChildren(...planNodes(plan, context));
    if (plan.program) predict(plan, () => mine === turn);
  }

  // the forecast of the page Program, existing or computed now
  async function predict({program: {name, sha256}, method: chosen}, current) {
    if (chosen !== FORECAST_METHOD) { predicted.textContent = t("arm.predicted.none"); return; }
    predicted.textContent = t("arm.predicting");
    try {
      const {programs} = await context.get("/api/program");
      let told = programs.some(({digest, state}) => digest === sha256 && state !== "failed" && state !== "cancelled")
        ? await context.get(`/api/program/${sha256}`) : await context.post(`/api/program/named?${new URLSearchParams({name})}`);
      while (current() && dialog.open && ["waiting", "computing"].includes(told.state)) {
        await new Promise((resolve) => setTimeout(resolve, POLL_MS));
        told = await context.get(`/api/program/${told.digest}`);
      }
      if (!current()) return;
      const forecast = told.forecast;
      const um = (value) => context.number(value, 3);
      predicted.textContent = !forecast ? t("arm.predicted.failed", {text: told.fault?.text ?? told.state})
        : forecast.refused.length ? t("arm.predicted.refused", forecast.refused[0])
          : t("arm.predicted", {before: um(forecast.before.rms_um), after: um(forecast.after.rms_um), max: um(forecast.after.max_um)});
    } catch (fault) {
      if (current()) predicted.textContent = t("arm.predicted.failed", {text: fault.text ?? fault.message});
    }
  }

  async function act(event) {
    event.preventDefault();
    if (!plan) return;
    confirm.disabled = program.disabled = method.disabled = true;
    told.replaceChildren(el("p", {}, t("arm.asked")));
    try {
      const answer = await context.post("/api/machine/arm",
        {program: plan.program?.name ?? null, method: plan.method, confirm: plan.confirm}, {signal: stopping.signal});
      told.replaceChildren(el("p", {}, t("arm.waiting")));
      await context.until((status) => status.armed || status.state === "OFF(SHADOW)");  // closed once the guard reports it
      context.say(answer.text);
      dialog.close();
    } catch (fault) {
      if (fault.name === "AbortError") return;
      program.disabled = method.disabled = false;
      told.replaceChildren(faultBox(fault));
      told.querySelector(".fault").append(...(fault.document?.refused ?? []).slice(1).map((more) => el("p", {}, more)));
      confirm.disabled = fault.code === "PlanChanged";
      if (fault.code === "PlanChanged") look();
    }
    context.lookNow();
  }

  dialog.addEventListener("close", () => { stopping.abort(); dialog.remove(); document.getElementById("arm")?.focus(); });
  document.body.append(dialog);
  dialog.showModal();
}

function planNodes(plan, {t, number, when}) {
  const feeds = plan.program === null;
  const names = Object.keys(plan.axes);
  const head = feeds
    ? [t("machine.axis"), t("arm.torque"), t("arm.turning")] : [t("machine.axis"), t("arm.offset"), t("arm.speed"), t("arm.acceleration")];
  const keys = feeds ? ["max_torque_nm", "max_speed_rad_s"] : ["max_offset_um", "max_speed_mm_s", "max_acceleration_mm_s2"];
  return [
    plan.difference ? el("p", {class: "fault"}, plan.difference) : null,
    el("p", {}, el("strong", {}, t(feeds ? "arm.moves.feeds" : "arm.moves", {axes: names.join(", "), program: plan.program?.name ?? ""}))),
    table({
      caption: t("arm.limits"), head,
      rows: names.map((axis) => [axis, ...keys.map((key) => (plan.axes[axis][key] === null ? "–" : `±${number(plan.axes[axis][key], 5)}`))]),
    }),
    plan.program ? el("p", {class: "soft digest"}, t("arm.file", {
      size: number(plan.program.size_bytes, 12), digest: plan.program.sha256.slice(0, 16),
      when: when(plan.program.changed_wall_s),
    })) : null,
    el("p", {}, t("arm.then")),
  ].filter(Boolean);
}

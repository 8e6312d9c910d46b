// Arming: choose what, see what it may move, confirm. To disarm asks nothing; the button for that is in the head of every page.

import {el, faultBox, table} from "/static/dom.js";

export function armingPanel(context) {
  const {t, session} = context;
  const open = el("button", {type: "button", class: "primary", id: "arm", onclick: () => choose(context)}, t("arm.open"));
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

async function choose(context) {
  const {t} = context;
  let choice;
  try {
    choice = await context.get("/api/machine/programs");
  } catch (fault) {
    context.say(`${fault.code}: ${fault.text}`);
    return;
  }
  const program = el("select", {id: "arm-program", onchange: () => look()},
    choice.programs.map(({name}) => el("option", {value: name}, name)),
    choice.feedforward ? el("option", {value: ""}, t("arm.program.none")) : null);
  const method = el("select", {id: "arm-method", onchange: () => look()},
    choice.methods.map((name) => el("option", {value: name, selected: name === "inverse"}, t(`method.${name}`))));
  const shown = el("div", {"aria-live": "polite", id: "arm-plan"});
  const told = el("div", {"aria-live": "assertive"});
  const confirm = el("button", {type: "submit", class: "primary", disabled: true}, t("arm.confirm"));
  // the dialog covers the head of the page, and with it the button that must always be there
  const disarm = el("button", {type: "button", class: "stop", onclick: context.disarm}, t("disarm"));
  const dialog = el("dialog", {id: "arming", "aria-labelledby": "arm-title"}, el("form", {method: "dialog", onsubmit: act},
    el("h2", {id: "arm-title"}, t("arm.title")),
    el("label", {for: "arm-program"}, t("arm.program")), program,
    choice.programs.length || choice.feedforward ? null : el("p", {}, t("arm.programs.none")),
    el("label", {for: "arm-method"}, t("arm.method")), method, shown, told,
    el("p", {class: "actions"}, confirm, el("button", {type: "button", onclick: () => dialog.close()}, t("arm.cancel")), disarm)));
  let plan = null;
  let turn = 0;
  const stopping = new AbortController();

  async function look() {
    const mine = ++turn;
    plan = null;
    confirm.disabled = true;
    told.replaceChildren();
    const query = new URLSearchParams({method: method.value, ...(program.value ? {program: program.value} : {})});
    const found = await context.get(`/api/machine/plan?${query}`).catch((fault) => ({fault}));
    if (mine !== turn) return;
    if (found.fault) { shown.replaceChildren(faultBox(found.fault)); return; }
    plan = found;
    confirm.disabled = false;
    shown.replaceChildren(...planNodes(plan, context));
  }

  async function act(event) {
    event.preventDefault();
    if (!plan) return;
    confirm.disabled = program.disabled = method.disabled = true;
    told.replaceChildren(el("p", {}, t("arm.asked")));
    try {
      const answer = await context.post("/api/machine/arm",
        {program: plan.program?.name ?? null, method: plan.method, confirm: plan.confirm}, {signal: stopping.signal});
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
  if (choice.programs.length || choice.feedforward) look();
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

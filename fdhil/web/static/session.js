// Who is logged in, and the dialog to log in.

import {el, faultBox} from "/static/dom.js";
import {get, keep, ask, post} from "/static/ask.js";
import {t} from "/static/text.js";

let who = {name: "", role: null, login_needed: true, acting: false};
const changes = new EventTarget();

export const session = () => who;
export const onSession = (f) => changes.addEventListener("change", f);

function became(now) {
  who = now;
  changes.dispatchEvent(new Event("change"));
}

export async function lookWho() {
  became(await get("/api/session"));
}

export async function logOut() {
  await ask("/api/session", {method: "DELETE"}).catch(() => null);
  keep(null);
  await lookWho();
}

// resolves to true after a login, to false if it was cancelled
export function logIn() {
  return new Promise((resolve) => {
    const name = el("input", {name: "name", id: "login-name", autocomplete: "username", required: true, maxlength: "64"});
    const password = el("input", {
      name: "password", id: "login-password", type: "password", autocomplete: "current-password", required: true, maxlength: "200",
    });
    const told = el("div", {"aria-live": "assertive"});
    const dialog = el("dialog", {"aria-labelledby": "login-title"},
      el("form", {method: "dialog", onsubmit: submit},
        el("h2", {id: "login-title"}, t("login.title")),
        el("label", {for: "login-name"}, t("login.name")), name,
        el("label", {for: "login-password"}, t("login.password")), password,
        told,
        el("p", {class: "actions"},
          el("button", {type: "submit", class: "primary"}, t("login")),
          el("button", {type: "button", onclick: () => dialog.close()}, t("login.cancel")))));
    let done = false;
    async function submit(event) {
      event.preventDefault();
      try {
        const {token, ...now} = await post("/api/session", {name: name.value, password: password.value});
        keep(token);
        done = true;
        became(now);
        dialog.close();
      } catch (fault) {
        told.replaceChildren(faultBox(fault));
        password.value = "";
        password.focus();
      }
    }
    dialog.addEventListener("close", () => { dialog.remove(); resolve(done); });
    document.body.append(dialog);
    dialog.showModal();
    name.focus();
  });
}

// Requests the machine's state once a second for the whole page. watch(f) calls f({told, status, fault}):
// the answer of /api/machine, the daemon's newest status document (kept while it is silent), and the fault, else null.

import {get} from "/static/ask.js";

const PERIOD_MS = 1000;
const watchers = new Set();
let last = null;
let timer = null;
let asking = false;

async function look() {
  if (asking) return;
  asking = true;
  clearTimeout(timer);
  try {
    const told = await get("/api/machine");
    last = {told, status: told.status ?? last?.status ?? null, fault: told.fault};
  } catch (fault) {
    last = {told: last?.told ?? null, status: last?.status ?? null, fault};
  }
  asking = false;
  for (const f of [...watchers]) f(last);
  timer = watchers.size && !document.hidden ? setTimeout(look, PERIOD_MS) : null;
}

document.addEventListener("visibilitychange", () => { if (!document.hidden && watchers.size) look(); });

export function watch(f) {
  watchers.add(f);
  if (last) f(last);
  if (timer === null) look();
  return () => watchers.delete(f);
}

export const lookNow = look;

// resolves to true once the status passes the test, to false after the given ms
export function until(test, within = 10000) {
  return new Promise((resolve) => {
    const end = (passed) => { clearTimeout(timer); queueMicrotask(() => stop()); resolve(passed); };
    const timer = setTimeout(() => end(false), within);
    const stop = watch(({status, fault}) => { if (status && !fault && test(status)) end(true); });
    look();
  });
}

// All texts in English, by key. The texts of a page are in en/PAGE.js, the shared ones here.

import events from "/static/text/en/events.js";
import fleet from "/static/text/en/fleet.js";
import history from "/static/text/en/history.js";
import live from "/static/text/en/live.js";
import machine from "/static/text/en/machine.js";
import panel from "/static/text/en/panel.js";
import program from "/static/text/en/program.js";
import rapids from "/static/text/en/rapids.js";

export default {
  "nav.machine": "Machine",
  "nav.live": "Live",
  "nav.rapids": "Rapids",
  "nav.history": "History",
  "nav.program": "Program",
  "nav.events": "Events",
  "nav.fleet": "Fleet",
  "page.missing": "There is no page at this address.",
  "page.failed": "This page could not be shown: {text}",
  "page.loading": "Loading …",
  "times.zone": "Times in the zone {zone}",
  "skip": "Skip to content",
  "login": "Log in",
  "login.title": "Log in",
  "login.name": "Name",
  "login.password": "Password",
  "login.needed": "Log in to see the machine.",
  "login.cancel": "Cancel",
  "logout": "Log out {name}",
  "logout.done": "You are logged out.",
  "login.done": "Logged in as {name}, role {role}.",
  "disarm": "Disarm",
  "disarm.asked": "Disarming: the correction is ramped to zero …",
  "disarm.done": "Disarmed. {text}",
  "state": "Correction: {state}",
  "state.unknown": "Correction: unknown",
  "daemon.silent": "The daemon does not answer. The figures shown are old.",
  "daemon.back": "The daemon answers again.",
  "network.lost": "fdhil web does not answer. Is it running, and is the network available?",
  "network.advice": "It is retried every few seconds.",
  "ago.never": "never",
  "ago.seconds": "{count} s ago",
  "ago.minutes": "{count} min ago",
  "ago.hours": "{count} h ago",
  ...fleet, ...machine, ...live, ...rapids, ...history, ...program, ...events, ...panel,
};

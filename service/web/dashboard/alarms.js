// Alarms on every view: how many, the critical one as the largest thing on the page, the others as lines.

import { SEVERITIES, SYMBOLS, ago, clock, make, milliseconds, put, toneOf } from "./words.js";

const LINES = 3; // of those that are not critical

const $ = (selector) => document.querySelector(selector);

// What lasts comes first, then what nobody has acknowledged, then what is worse, then what is newer.
export function worstFirst(a, b) {
  const rank = (alarm) => [
    alarm.severity ? 1 : 0, alarm.acknowledged ? 0 : 1, SEVERITIES.indexOf(alarm.worst_severity), alarm.since_ns_utc];
  const [one, other] = [rank(a), rank(b)];
  const k = one.findIndex((value, i) => value !== other[i]);
  return k < 0 ? 0 : other[k] - one[k];
}

export function lasting(state) {
  return (state?.alarms ?? []).filter((alarm) => !alarm.muted).sort(worstFirst);
}

// Alarms that nobody has acknowledged, whether they last or not.
export function unseen(state) {
  return [...(state?.alarms ?? []), ...(state?.stale_alarms ?? [])].filter((alarm) => !alarm.muted && !alarm.acknowledged);
}

// Where the manual says what to do; null: rules of an observatory's own are not in it.
export function runbookOf(name) {
  return name.includes(".") ? null : `manual/operate/runbook.html#${name}`;
}

// The first clause stands by itself: it is what is read from afar.
export function firstClause(text) {
  return text.split(/[;:(]|\. /)[0].trim().replace(/\.$/, "");
}

function sentence(text) {
  return text && text[0].toUpperCase() + text.slice(1);
}

export function showAlarmCount(service) {
  const { state, fresh } = service;
  const shown = lasting(state);
  const worst = SEVERITIES.findLast((severity) => shown.some((alarm) => alarm.severity === severity));
  const others = [[state?.stale_alarms, "unseen"], [state?.muted_alarms, "muted"]].filter(([list]) => list?.length);
  const count = shown.length ? `${SYMBOLS[worst]} ${shown.length} alarm${shown.length > 1 ? "s" : ""}` : `${SYMBOLS.none} no alarm`;
  const link = $("#alarm-count");
  put(link, fresh ? [count, ...others.map(([list, word]) => `${list.length} ${word}`)].join(", ") : "alarms –");
  link.dataset.tone = !fresh ? "" : toneOf(worst) || (state.stale_alarms.length ? "warn" : "");
  return fresh ? shown.length : 0;
}

// On the other pages, and on a small screen, the list of alarms is out of sight: the worst of them are lines.
export function showAlarmLines(service) {
  const rest = service.fresh ? lasting(service.state).filter((alarm) => alarm.severity !== "critical") : [];
  const lines = rest.slice(0, LINES).map((a) => ({ text: `${SYMBOLS[a.severity]} ${a.name}: ${a.text}`, tone: toneOf(a.severity) }));
  if (rest.length > LINES) lines.push({ text: `and ${rest.length - LINES} more`, tone: "" });
  const list = $("#alarm-lines");
  const told = JSON.stringify(lines);
  if (list.dataset.told === told) return;
  list.dataset.told = told;
  list.replaceChildren(...lines.map(({ text, tone }) => make("li", { text, title: text, data_tone: tone })));
}

// A critical alarm that lasts and is muted is no news, and still there.
function mutedCritical(state) {
  return (state?.alarms ?? []).filter((alarm) => alarm.muted && alarm.severity === "critical").sort(worstFirst);
}

// A banner under the header: what is the matter, what to do, where more is said. Smaller once somebody knows, a line once it is muted.
export class CriticalBanner {
  #service;
  #root = $("#critical");
  #name = "";

  constructor(service, orders) {
    this.#service = service;
    this.#root.querySelector("button").addEventListener("click", () => orders.open("acknowledge", this.#name));
  }

  show() {
    const { state, fresh, now } = this.#service;
    // one that was there when the connection was lost is not over for that
    const critical = [...lasting(state).filter(({ severity }) => severity === "critical"), ...mutedCritical(state)];
    const [alarm, ...others] = this.#service.locked ? [] : critical;
    this.#root.hidden = !alarm;
    document.body.dataset.alarm = !alarm ? "" : alarm.muted ? "muted" : alarm.acknowledged ? "known" : "critical";
    if (!alarm) return;
    this.#name = alarm.name;
    const part = (selector) => this.#root.querySelector(selector);
    const { acknowledged: seen, muted } = alarm;
    const since = milliseconds(alarm.since_ns_utc);
    const known = muted ? `; muted by ${muted.by} until ${clock(milliseconds(muted.until_ns_utc))} UTC` : seen ? `; acknowledged by ${seen.by}` : "";
    put(part("h2"), `${muted ? SYMBOLS.muted : SYMBOLS.critical} ${alarm.name}`);
    put(part(".cause"), sentence(firstClause(alarm.cause || alarm.text)));
    put(part(".remedy span"), firstClause(alarm.do));
    part(".remedy").hidden = !alarm.do || Boolean(muted);
    put(part(".found"), alarm.text);
    part(".found").hidden = Boolean(muted);
    put(part(".since"), `since ${clock(since)} UTC, ${ago(since, now, true)}${known}${fresh ? "" : "; last known"}`);
    const runbook = runbookOf(alarm.name);
    part("a").hidden = !runbook;
    if (runbook) part("a").href = runbook;
    part("button").hidden = Boolean(seen || muted);
    put(part(".others"), others.length ? `also critical: ${others.map(({ name, muted: hushed }) => (hushed ? `${name} (muted)` : name)).join(", ")}` : "");
  }
}

// The header, what waits for the operator, the loop, and the reconstructors.

import { lasting, showAlarmCount } from "./alarms.js";
import { margin, described, usable } from "./orders.js";
import {
  DASH, SYMBOLS, ago, clock, make, milliseconds, nanometres, number, operation, present, put, registrationOf, shortly, span, verdict,
} from "./words.js";
import { bar, soFar } from "./work.js";

const $ = (selector) => document.querySelector(selector);
const UNKNOWN = { word: "NOT KNOWN", symbol: SYMBOLS.lost, tone: "bad", why: "the connection to the service is lost" };

export function showHeader(service, orders) {
  const { state, fresh, now } = service;
  const { word, symbol, tone, why } = fresh ? operation(state) : UNKNOWN;
  put($("#system"), state?.system ?? "pyrcal");
  const operational = $("#operation");
  put(operational, `${symbol} ${word}`);
  operational.dataset.tone = tone;
  operational.title = why;
  put($("#utc"), `${clock(now)} UTC`);
  const chosen = $("#mode");
  if (state && document.activeElement !== chosen) chosen.value = state.mode;
  chosen.disabled = Boolean(orders.whyNot("mode"));
  put($("#rtc"), rtcLine(state, fresh));
  const stop = $("#stop");
  stop.dataset.order = state?.stopped_because ? "resume" : "stop";
  put(stop, state?.stopped_because ? "Release" : "Stop everything");
  const n = showAlarmCount(service);
  document.title = `${n ? `(${n}) ` : ""}${word} ${state?.system ?? "pyrcal"}`;
}

function rtcLine(state, fresh) {
  const rtc = state?.rtc;
  if (!fresh || !state) return `RTC ${DASH}`;
  if (!rtc) return "RTC not connected";
  return `RTC ${number(rtc.frame_rate_hz, 0)} Hz, ${state.link.frames_lost} lost`;
}

// A banner across the page while nothing new comes.
export function showConnection(service) {
  const lost = !service.fresh;
  const banner = $("#lost");
  if (banner.hidden === lost) banner.hidden = !lost;
  document.body.classList.toggle("lost", lost);
  if (!lost) return;
  const text = service.locked ? `${SYMBOLS.lost} This service requires a key: log in at the top of the page.`
    : service.state ? `${SYMBOLS.lost} CONNECTION LOST: what is shown is ${span(service.age_s)} old. Trying again.`
    : `${SYMBOLS.busy} Waiting for the service: no answer yet. Trying again.`;
  put(banner, text);
}

export function showWaiting(service, orders) {
  const { state, fresh } = service;
  const bar = $("#waiting");
  const { proposal } = orders;
  const told = new Set(["approval", ...lasting(state).filter((a) => a.severity === "critical").map((a) => a.name)]);
  const others = (state?.waiting_for ?? []).filter((w) => !told.has(w.name)); // of the others the page says so already
  bar.hidden = !fresh || (!proposal && !others.length);
  bar.dataset.asks = String(Boolean(proposal));
  put($("#waiting-title"), proposal ? "WAITING FOR YOU" : "WAITING FOR");
  const approval = (state?.waiting_for ?? []).find(({ name }) => name === "approval")?.text ?? "";
  const besides = approval.split("; ").slice(1); // why nobody else sends it, and when another one replaces it
  put($("#proposal"), proposal ? [described(proposal, orders.wins), ...besides].join("; ") : "");
  $("#proposal-buttons").hidden = !proposal;
  const lines = others.slice(0, 3).map((w) => `${w.responsible}: ${w.text}`);
  if (others.length > 3) lines.push(`and ${others.length - 3} more`);
  listed($("#waits"), lines);
}

function listed(list, lines) {
  if ((list.dataset.lines ?? "") === lines.join("\n")) return;
  list.dataset.lines = lines.join("\n");
  list.replaceChildren(...lines.map((text) => make("li", { text, title: text })));
}

export function showWork(service, orders) {
  const work = service.fresh ? orders.work : null;
  $("#work").hidden = !work;
  if (!work) return;
  put($("#work-title"), `${SYMBOLS.busy} ${work.title}`);
  put($("#work-text"), soFar(work, service.now));
  bar($("#work progress"), work.share, work.title);
  const button = $("#work-end");
  button.dataset.order = work.order;
  put(button, work.button);
}

export function showLoop(service, mirror) {
  const { state, fresh } = service;
  const root = $("#loop");
  const rtc = state?.rtc;
  root.classList.toggle("old", !fresh || !rtc);
  const expected = state?.assessment?.id === state?.in_use ? state?.assessment?.expected : null;
  const gains = (state?.registration?.optical_gains ?? []).map((g) => g.gain);
  const delay = rtc ? number(rtc.delay_frames, 1).replace(/\.0$/, "") : DASH;
  put($("#loop-state"), rtc ? `${rtc.loop}, ${rtc.n_controlled} of ${rtc.n_modes} modes, ${delay} frames delay` : DASH);
  put($("#wavefront"), expected ? `${nanometres(expected.wavefront_m)}, and ${nanometres(expected.loss_m)} lost by the matrix in use${before(state, expected)}` : DASH);
  put($("#optical-gain"), gains.length ? `${number(Math.min(...gains))} to ${number(Math.max(...gains))}, ${gains.length} modes` : DASH);
  const judged = margin(state?.margin);
  gauge($("#margin"), judged && judged.radius / judged.bound, judged ? judged.text : DASH);
  const edge = state?.margin?.edge_motion_m;
  const limit = mirror?.edge_limit_m;
  gauge($("#edge"), present(edge) && limit ? edge / limit : null, present(edge) ? `${nanometres(edge)} of ${nanometres(limit)}` : DASH);
  const since = state?.reference_since_ns_utc;
  put($("#references"), state?.reference_id ? `${state.reference_id}${state.references?.used ? "" : present(since) ? `, since ${when(since, service.now)}` : ", unchanged"}` : DASH);
  const dither = state?.dither_policy;
  put($("#dither"), !rtc && dither ? `${dither.phase}: ${dither.reason}` : dither ? `${dither.phase}, ${nanometres(dither.mean_cost_m)} of ${nanometres(dither.budget_m)}: ${dither.reason}` : DASH);
  const link = state?.link;
  put($("#frames"), link ? `${link.frames_received} received, ${link.frames_lost} lost, last ${present(link.frame_age_s) ? `${span(link.frame_age_s)} ago` : DASH}${link.telemetry_age_s >= 1 ? `, ${span(link.telemetry_age_s)} old on arrival` : ""}` : DASH);
}

// What the matrix before left, by the same model: a swap shows what it was for.
const foreseen = []; // under each matrix in use since the page was opened, oldest first
function before(state, { wavefront_m: best, loss_m: loss }) {
  if (foreseen.at(-1)?.id !== state.in_use) foreseen.push({ id: state.in_use });
  Object.assign(foreseen.at(-1), { total: best + (loss ?? Infinity), modes: state.rtc?.n_controlled });
  if (foreseen.length > 2) foreseen.shift();
  const last = foreseen.length > 1 ? foreseen[0] : null;
  return last ? `; before the swap ${Number.isFinite(last.total) ? nanometres(last.total) : "unstable"} with ${last.modes} modes` : "";
}

// A bar with its limit; the words beside it say the same.
function gauge(root, share, text) {
  const bar = root.querySelector("meter");
  bar.hidden = !present(share);
  if (present(share)) bar.value = Math.min(Math.max(share, 0), 1.2);
  const word = !present(share) || share <= bar.low ? "" : share <= 1 ? ", near the limit" : ", beyond the limit";
  put(root.querySelector("span"), `${text}${word}`);
}

export function showProvenance(service, orders) {
  const { state, now, fresh } = service;
  const record = orders.inUse;
  $("#provenance").classList.toggle("old", !fresh);
  if (!state?.in_use) return put($("#provenance"), `in use: ${DASH} (the RTC has not reported its matrix)`);
  if (!record) return put($("#provenance"), `in use: ${state.in_use}, without a record in this service`);
  if (!record.alpha) return put($("#provenance"), `in use: ${record.id}, ${record.n_modes} modes; the RTC's own, registration unknown`);
  const frame = present(record.applied_frame_seq) ? `, applied at frame ${record.applied_frame_seq}` : "";
  const sent = record.published_ns_utc ? `, sent ${when(record.published_ns_utc, now)}` : "";
  const trial = [state.probation?.id, state.probation?.rollback].includes(record.id) ? `; probation: ${state.probation.state}` + (state.probation.state === "passed" ? "" : `, ${state.probation.text}`) : "";
  return put($("#provenance"), `in use: ${record.id}, ${record.n_modes} modes${frame}${sent}, for ${shortly(record.alpha, record.sigma)}${trial}`);
}

function when(ns, now) {
  const ms = milliseconds(ns);
  return `${clock(ms)} UTC, ${ago(ms, now)}`;
}

export function showReconstructors(service, orders) {
  const { now } = service;
  const roles = [["waiting", orders.proposal], ["in use", orders.inUse], ["previous", orders.before]];
  const others = service.reconstructors.filter((r) => !roles.some(([, role]) => role?.id === r.id)).slice(-12).reverse();
  const rows = [...roles, ...others.map((r) => [r.state, r])].filter(([, r]) => r).map(([role, r]) => make(
    "tr", { className: role === "in use" ? "in-use" : "" },
    make("th", { scope: "row", text: role }),
    make("td", { text: r.id }),
    make("td", { className: "n", text: String(r.n_modes) }),
    make("td", r.alpha ? { text: shortly(r.alpha, r.sigma), title: registrationOf(r.alpha, r.sigma) } : { text: r.origin }),
    make("td", { text: `${r.gate && !r.gate.accepted ? "REFUSED, " : ""}${margin(r.gate)?.text ?? "not checked"}`, title: verdict(r.gate) }),
    make("td", { text: r.created_ns_utc > 0 ? ago(milliseconds(r.created_ns_utc), now, true) : DASH }),
    make("td", { text: r.reason || DASH, title: r.reason }),
  ));
  if (!rows.length) rows.push(make("tr", {}, make("td", { colspan: "7", text: "no reconstructor yet" })));
  $("#reconstructors tbody").replaceChildren(...rows);
}

export function showButtons(orders) {
  for (const button of document.querySelectorAll("[data-order]")) usable(button, orders.whyNot(button.dataset.order));
}

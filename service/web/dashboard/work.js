// What takes long: what it is at, how much is done, when it will be over, and what ends it.

import { milliseconds, span } from "./words.js";

const STAGES = ["opening", "coarse", "confirming", "partial", "widening"];
const RAMPING = new Set(["asked", "accepted"]);

// What occupies the loop or the mirror, from a state; null: nothing that takes long.
// share: 0 to 1, null where nobody knows; left_s as well.
export function busy(state, now) {
  const { acquisition, measuring, noisy_measurement, loop_command: asked, rtc } = state;
  if (acquisition.under_way) {
    const k = STAGES.indexOf(acquisition.stage);
    return {
      title: `Acquisition, stage ${k + 1} of ${STAGES.length}: ${acquisition.stage}`, text: acquisition.text,
      share: k / STAGES.length, left_s: null, since: acquisition.started_ns_utc, order: "abort", button: "Abort",
    };
  }
  const one = measuring ?? noisy_measurement;
  if (one) {
    const sofar = one.state === "finishing" ? "being fitted and stored" : one.state === "waiting" ? "waiting for the dither to end" : one.state;
    const what = `${sofar}${measuring ? `, ${measuring.pattern}, ${measuring.modes.length} modes` : ""}`;
    return { title: `Measuring ${one.id}`, text: what, ...timed(one.asked_ns_utc, one.duration_s, now), order: "give-up", button: "Cancel" };
  }
  const ramp = asked?.lasts_s && RAMPING.has(asked.state) && rtc && rtc.loop !== "open" ? asked : null;
  const over = ramp && now - milliseconds(ramp.asked_ns_utc) > 1000 * (ramp.lasts_s + 10);
  if (!ramp || over) return null;
  return { title: "Gain ramp", text: ramp.text, ...timed(ramp.asked_ns_utc, ramp.lasts_s, now), order: "open-loop", button: "End" };
}

function timed(since, lasts_s, now) {
  const gone_s = (now - milliseconds(since)) / 1000;
  if (!lasts_s) return { since, share: null, left_s: null };
  return { since, share: Math.min(gone_s / lasts_s, 1), left_s: Math.max(lasts_s - gone_s, 0) };
}

// How far it is, as a line: what is not known is not guessed.
export function soFar({ text, since, left_s: left }, now) {
  const until = left === null ? "" : left > 0 ? `, about ${span(left)} left` : ", ending";
  return `${text}; for ${span((now - milliseconds(since)) / 1000)}${until}`;
}

// A bar that is full at the end, and moves without a measure where nobody knows how far it is.
export function bar(element, share, label) {
  if (share === null) element.removeAttribute("value");
  else element.value = share;
  element.setAttribute("aria-label", label);
  return element;
}

"""Nights that were recorded with earlier records, as they would be written today.

Earlier the tracker had records of its own for the RTC's status, for dithers and for each kind of
question and answer; now they are the wire's. A noisy interaction matrix had one of its own, too.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from studies.campaign.golden_codec import Json

Record = dict[str, Json]

_LOOP = {None: None, True: "closed", False: "open"}
_ANSWERS = {"running": True, "refused": False}


class Renewal:
    """Renews the entries of one night, which must come in their order: answers name no question."""

    def __init__(self) -> None:
        self._t_ns = 0
        self._session = ""
        self._asked: dict[str, Record] = {}
        self._changed: Mapping[str, Callable[[Record], Record]] = {
            "StatusSeen": self._status,
            "Acknowledged": self._acknowledgement,
            "AskDither": lambda old: self._ask(_dither_request(old["dither"])),
            "AskNoDither": lambda _: self._ask({"is": "DitherStop", "id": f"stop-{self._t_ns}"}),
            "AskMeasurement": lambda old: self._ask(_measure_request(old["record"])),
            "AskLoop": self._ask_loop,
            "AskRamp": lambda old: self._ask(old | {"is": "RampRequest"}),
            "DitherAnswered": self._answered,
            "LoopAnswered": self._answered,
            "MatrixMeasured": self._measured,
            "SetLoop": _set_loop,
            "Ramp": _ramp,
            "StartDither": _total,
            "MeasureNoisy": _total,
            "SetPointing": lambda old: old.get("pointing", old) | {"is": "SetPointing"},
            "NoisyMade": lambda old: old | {"is": "MatrixMeasured"},
            "NoisyRecord": _measurement,
            "GiveUpNoisy": lambda old: old | {"is": "GiveUp"},
        }

    def entry(self, entry: Record) -> Record:
        """Return the next entry."""
        self._t_ns = entry["t"]
        if entry.get("event", {}).get("state") == "failed":
            entry = _failed(entry)
        if "log" in entry:
            entry = entry | {"log": [[_said(text) for text in line] for line in entry["log"]]}
        if entry.get("event", {}).get("is") == "GiveUpNoisy" and "refused" in entry:
            entry = entry | {"refused": _of_any_matrix(entry["refused"])}
        return {name: self._renewed(item) for name, item in entry.items()}

    def _renewed(self, value: Json) -> Json:
        if isinstance(value, list):
            return [self._renewed(item) for item in value]
        if not isinstance(value, dict):
            return value
        change = self._changed.get(value.get("is", ""))
        whole = value if change is None else change(value)
        return {name: self._renewed(item) for name, item in whole.items()}

    def _status(self, old: Record) -> Record:
        view = dict(old["rtc"])
        self._session = view["session"]
        dither, seq = view.pop("dither", None), view.pop("seq", -1)
        if dither is not None:
            request = _dither_request(dither)
            dither = {"is": "DitherStatus", "request": request, "start_seq": dither["start_seq"]}
        del view["dither_id"]
        changed = {"is": "Status", "t_ns": view.pop("t_ns_utc"), "dither": dither}
        return view | changed | {"seq": None if seq < 0 else seq}

    def _acknowledgement(self, old: Record) -> Record:
        session = old.get("session") or self._session
        return old | {"is": "Acknowledgement", "session": session, "sha256": old.get("sha256")}

    def _ask(self, request: Record) -> Record:
        self._asked[request["id"]] = request
        return {"is": "Ask", "request": request}

    def _ask_loop(self, old: Record) -> Record:
        request = old | {"is": "LoopRequest", "loop": _LOOP[old.get("closed")]}
        judged = request.pop("judged", False)
        request.pop("closed", None)
        return self._ask(request) | ({"judged": True} if judged else {})

    def _answered(self, old: Record) -> Record:
        request = self._asked.get(old["id"], {"is": "LoopRequest", "id": old["id"]})
        reply = {"start_seq": None} | old | {"is": "Reply"}
        return {"is": "Answered", "request": request, "reply": reply}

    def _measured(self, old: Record) -> Record:
        record = old["record"]
        accepted = _ANSWERS.get(record["state"])
        if accepted is None:
            return old
        reply = {
            "is": "Reply",
            "id": record["id"],
            "accepted": accepted,
            "reason": record.get("reason", ""),
            "start_seq": record.get("start_seq"),
        }
        return {"is": "Answered", "request": self._asked[record["id"]], "reply": reply}


def _failed(entry: Record) -> Record:
    """Tell as a failure to send what no RTC can acknowledge: it puts one more line on record."""
    text = entry["event"]["reason"]
    effect = {"is": "SendMatrix", "id": entry["event"]["id"], "n_modes": 0, "gains": None}
    failure = {"is": "JobFailed", "effect": effect, "text": text}
    return entry | {"event": failure, "log": [["job.failed", text, "warning"]]}


def _set_loop(old: Record) -> Record:
    order = dict(old)
    closed = order.pop("closed", None)
    return order if closed is None else order | {"loop": _LOOP[closed]}


def _ramp(old: Record) -> Record:
    groups = [
        {"is": "ModeGroup", "first": group[0], "last": group[1]}
        if isinstance(group, list)
        else group
        for group in old.get("groups", ())
    ]
    return old | ({"groups": groups} if groups else {})


def _total(old: Record) -> Record:
    order = dict(old)
    total_m = order.pop("total_m", None)
    return order if total_m is None else order | {"total_amplitude_m": total_m}


def _said(text: str) -> str:
    """Return a line of the log as it says to a person what to do: in words, not in REST's."""
    for rest, words in (
        (
            "POST /v1/dither with start lets it dither again",
            "start the dither to let it dither again",
        ),
        (": PUT /v1/mode changes it", "; set the mode to change it"),
    ):
        text = text.replace(rest, words)
    return text


def _of_any_matrix(refused: str) -> str:
    """Return the refusal to give up a noisy matrix, as it is told of every measured one."""
    return refused.replace("GiveUpNoisy", "GiveUp").replace(": noisy matrix ", ": measurement ")


def _dither_request(view: Record) -> Record:
    request = {name: view[name] for name in ("id", "modes", "amplitude_m", "duration_s")}
    lines = {"frequency_hz": view["frequency_hz"]} if view["frequency_hz"] else {}
    seed = {"seed": view["seed"]} if "seed" in view else {}
    return {"is": "DitherRequest", "kind": view.get("kind", "sine")} | request | lines | seed


def _measure_request(record: Record) -> Record:
    names = ("id", "pattern", "modes", "amplitude_m", "n_average", "frequency_hz", "duration_s")
    return {"is": "MeasureRequest"} | {name: record[name] for name in names if name in record}


def _measurement(noisy: Record) -> Record:
    n_modes = len(noisy["modes"])
    each_m = noisy["total_m"] / math.sqrt(n_modes)
    changed = {"is": "MeasurementRecord", "pattern": None, "amplitude_m": [each_m] * n_modes}
    return {name: value for name, value in noisy.items() if name != "total_m"} | changed

"""A reader of the manual, who types the blocks of a page in their order, in one folder."""

import contextlib
import io
import json
import os
import subprocess
import sys
import time

from tests.support.manual import commands
from tests.support.night import ROOT, wait_for
from tests.support.pace import patience
from tests.support.tutorial_blocks import ENDING, missing_lines, steps

PORT, LINK = "127.0.0.1:8080", "tcp/127.0.0.1:7447"
"""Addresses on the pages, replaced by those of the test."""


class Reader:
    """Someone with a terminal for what runs until it is ended, and another for the rest."""

    def __init__(self, folder, night):
        self.folder, self.night, self.names = folder, night, {}
        self.beside = {}
        """Processes that run beside the page, by command."""

        self.answer_id = "ID"
        """Id in the last JSON answer of curl, in the place of ID on a page."""

    def read(self, page):
        """Type the blocks of a page that are not marked; compare their output with the page."""
        for kind, text, printed in steps(page):
            expected = printed or ""
            for process in self.beside.values():
                assert process.popen.poll() in {None, 0}, process.log
            output = self.run_python(text, page) if kind == "python" else self.run_shell(text)
            if output is None:  # a process beside the page: its output comes as it runs
                process = list(self.beside.values())[-1]
                wait_for(
                    lambda e=expected, p=process: missing_lines(e, p.log) == [],
                    60.0,
                    lambda e=expected, p=process: (missing_lines(e, p.log), p.log),
                )
            elif kind == "sh" and only_asks(text):
                self.ask_until(text, expected, output)
            else:
                assert missing_lines(expected, output) == [], output
        for command, expected in ENDING.findall(page.read_text("utf-8")):
            process = self.beside[command]
            self.end(command)
            assert missing_lines(expected, process.log) == [], process.log

    def ask_until(self, text, expected, output):
        """Repeat a question, as a reader does who waits for the answer of the page."""
        answers = [output]

        def answered():
            if missing_lines(expected, answers[-1]) == []:
                return True
            time.sleep(3.0)
            answers.append(self.run_shell(text))
            return False

        wait_for(answered, 300.0, lambda: (missing_lines(expected, answers[-1]), answers[-1]))

    def run_python(self, text, page):
        output = io.StringIO()
        with contextlib.redirect_stdout(output):
            exec(compile(text, str(page), "exec"), self.names)
        return output.getvalue()

    def run_shell(self, text):
        """Run a block; return its output, None if its last command runs beside the page."""
        output = []
        for program, *words in commands(text):
            program = program.removeprefix(".venv/bin/")
            if program == "make":  # the environment that the test runs in
                assert words == ["setup"], words
            elif program == "pyrcal" and runs_beside(words):
                output = None
                self.start(words)
            elif program == "pyrcal":
                if words[0] == "check-rtc" and "--connect" not in words:
                    self.end("run")  # the checker takes its place
                words = self.with_addresses(words)
                output = [*(output or []), self.run([sys.executable, "-m", "pyrcal", *words])]
            else:
                output = [*(output or []), self.run_other(program, words)]
        return None if output is None else "\n".join(output)

    def run_other(self, program, words):
        if program == "python":
            return self.run([sys.executable, *words])
        if program == "curl":
            here = f"127.0.0.1:{self.night.port}"
            words = [word.replace(PORT, here) for word in words]
            words = [w[:-2] + self.answer_id if w.endswith("/ID") else w for w in words]
            text = self.run(["curl", "--silent", "--show-error", "--fail-with-body", *words])
            with contextlib.suppress(ValueError, KeyError, TypeError):
                self.answer_id = json.loads(text)["id"]
            return text
        return self.run([program, *words])

    def run(self, words, tries=3):
        done = subprocess.run(
            words,
            cwd=self.folder,
            capture_output=True,
            text=True,
            timeout=patience(300.0),
            check=False,
            env={
                **os.environ,
                "PYTHONPATH": str(ROOT),
                "PYRCAL_SERVICE__DATA_DIR": str(self.folder / "data"),
                "PYRCAL_URL": f"http://127.0.0.1:{self.night.port}",
            },
        )
        ends = {0, 1} if "status" in words else {0}  # 1: there is an alarm
        if done.returncode == 1 and "check-rtc" in words and tries > 1:
            return self.run(words, tries - 1)  # a busy machine is late; what is wrong stays so
        assert done.returncode in ends, (words, done.stdout, done.stderr)
        return done.stdout + done.stderr

    def with_addresses(self, words):
        """Return a command with the ports and folders of this test."""
        words = [self.night.zenoh if word == LINK else word for word in words]
        match words[0]:
            case "run":
                words += ["--port", str(self.night.port), "--listen", self.night.zenoh]
                if "--data-dir" not in words:
                    words += ["--data-dir", str(self.folder / "data")]
            case "demo":
                words += ["--port", str(self.night.port), "--dir", str(self.folder / "demo")]
                words += ["--zenoh-port", self.night.zenoh.rpartition(":")[2]]
            case "sim" if "--write-instrument" not in words:
                words += ["--connect", self.night.zenoh, "--seed", "3"]
            case "check-rtc" if "--connect" not in words:
                words += ["--listen", self.night.zenoh, "--seconds", "3"]
        return words

    def start(self, words):
        """Start a command that runs until it is ended, in the place of the one before it."""
        command, night = words[0], self.night
        for one in (command, *(["sim"] if command == "run" else ())):
            self.end(one)
        process = night.start(command, ["pyrcal", *self.with_addresses(words)], cwd=self.folder)
        self.beside[command] = process
        if command in {"run", "demo"}:
            wait_for(lambda: night.ready(process), 90.0, lambda: process.log)
        elif "run" in self.beside:
            night.wait_for_rtc(process)

    def end(self, command):
        """End what runs beside the page as Ctrl-C does, if it still runs."""
        process = self.beside.pop(command, None)
        if process is not None:
            process.send(2)
            process.ended(30.0)


def runs_beside(words):
    """True if a command runs until it is ended, or as long as it is asked to."""
    lasting = {"run", "demo"} | ({"sim"} if "--write-instrument" not in words else set())
    lasting |= {"cacao"} if len(words) == 3 else set()  # more: an order to the one that runs
    return words[0] in lasting and "--record" not in words and "--help" not in words


def only_asks(text):
    """True if a block only asks a running service, so that it may be repeated."""
    asking = {("status",), ("alpha",), ("audit",)}
    asking |= {(name, "list") for name in ("alarms", "reconstructors", "references")}
    typed = list(commands(text))
    return all(
        words[0].endswith("pyrcal") and any(tuple(words[1:])[: len(a)] == a for a in asking)
        for words in typed
    )

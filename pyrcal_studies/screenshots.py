"""Walks through docs/start/demo.md with a demo and a headless browser, and takes its pictures anew.

Run: ``python -m pyrcal_studies.screenshots``, then look at ``docs/start/*.png``: three minutes.
It needs Debian's chromium and chromium-driver, selenium and Pillow. A slow machine wants the jump
later than after 90 s: ``python -m pyrcal_studies.screenshots 200``.
"""

from __future__ import annotations

import io
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
from PIL import Image
from selenium import webdriver

PICTURES = Path(__file__).parents[1] / "docs" / "start"
SIZE = (1280, 860)
N_COLOURS = 48
"""A page of few colours: a picture stays below 100 kB."""

JUMP = "0.25,-0.1,0.15,0"
"""As the tutorial has it."""

PATIENCE_S = 400.0


def main() -> int:
    """Take the pictures; return the exit status."""
    PICTURES.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        port, zenoh_port = free_port(), free_port()
        words = ["--port", str(port), "--zenoh-port", str(zenoh_port), "--dir", f"{folder}/demo"]
        at_s = sys.argv[1] if len(sys.argv) > 1 else "90"
        command = [sys.executable, "-m", "pyrcal.demo", "--jump", f"{at_s}:{JUMP}", *words]
        demo = subprocess.Popen(command)
        try:
            walk(f"http://127.0.0.1:{port}")
        finally:
            demo.terminate()
            demo.wait(20.0)
    return 0


def walk(url: str) -> None:
    """Do what the tutorial says, and keep what is seen."""
    client = httpx.Client(base_url=url, timeout=20.0)
    wait(lambda: state(client).get("registration"), "the first estimate")
    driver = browser()
    try:
        driver.get(url)
        wait(lambda: own_matrix(client, 500), "500 modes in use")
        time.sleep(12.0)  # a chart of a few windows
        picture(driver, "tracking")
        before = state(client)["registration"]["alpha"]["shift_x_subap"]
        in_use = state(client)["in_use"]
        wait(lambda: moved(client, before), "the jump is seen")
        wait(lambda: state(client)["in_use"] != in_use, "it is corrected")
        time.sleep(12.0)
        picture(driver, "jump")
        order(client, "PUT", "/v1/mode", {"mode": "propose"})
        order(client, "POST", "/v1/refit", {})
        proposal = "!document.querySelector('#proposal-buttons').hidden"
        wait(lambda: driver.execute_script(f"return {proposal}"), "a proposal")
        driver.find_element("css selector", "[data-order=approve]").click()
        time.sleep(1.0)
        picture(driver, "approve")
        driver.find_element("css selector", "#order [value=send]").click()
        answer = "document.querySelector('#answer').innerText.includes('applied at frame')"
        wait(lambda: driver.execute_script(f"return {answer}"), "it is applied")
    finally:
        driver.quit()


def browser() -> webdriver.Chrome:
    """Return a headless browser, in the dark."""
    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or shutil.which("chromium-browser") or ""
    for word in ("headless=new", "no-sandbox", "disable-dev-shm-usage", "disable-gpu"):
        options.add_argument(f"--{word}")
    driver = webdriver.Chrome(options, webdriver.ChromeService(shutil.which("chromedriver")))
    size = {"width": SIZE[0], "height": SIZE[1], "deviceScaleFactor": 1, "mobile": False}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    return driver


def picture(driver: webdriver.Chrome, name: str) -> None:
    """Keep what is seen, in few colours."""
    seen = Image.open(io.BytesIO(driver.get_screenshot_as_png())).convert("RGB")
    path = PICTURES / f"{name}.png"
    seen.quantize(N_COLOURS, dither=Image.Dither.NONE).save(path, optimize=True)
    sys.stdout.write(f"{path.name}: {path.stat().st_size / 1000:.0f} kB\n")


def order(client: httpx.Client, method: str, path: str, body: dict[str, Any]) -> None:
    """Give an order, and see that it is carried out."""
    answer = client.request(method, path, json=body)
    answer.raise_for_status()


def state(client: httpx.Client) -> dict[str, Any]:
    """Return the state; empty: the service does not answer yet."""
    try:
        found: dict[str, Any] = client.get("/v1/state").json()
    except httpx.TransportError:
        return {}
    return found


def own_matrix(client: httpx.Client, n_modes: int) -> bool:
    """Return whether a matrix of this service, of so many modes, is in use."""
    answer = client.get("/v1/reconstructors/in-use")
    found = answer.json() if answer.is_success else {}
    return bool(found.get("parent") and found.get("n_modes") == n_modes)


def moved(client: httpx.Client, before: float) -> bool:
    """Return whether shift x is somewhere else."""
    return bool(abs(state(client)["registration"]["alpha"]["shift_x_subap"] - before) > 0.15)


def wait(condition: Callable[[], object], what: str) -> None:
    """Wait until it is so.

    Raises
    ------
    TimeoutError
        If it is not, within ``PATIENCE_S``.
    """
    until_s = time.monotonic() + PATIENCE_S
    while not condition():
        if time.monotonic() > until_s:
            raise TimeoutError(f"not within {PATIENCE_S:.0f} s: {what}")
        time.sleep(0.5)


def free_port() -> int:
    """Return a TCP port that nobody uses now."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port: int = listener.getsockname()[1]
    return port


if __name__ == "__main__":
    raise SystemExit(main())

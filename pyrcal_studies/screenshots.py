"""Takes the pictures of docs/start and of the operating pages with a demo and a headless browser.

Run: ``python -m pyrcal_studies.screenshots``, then look at ``docs/start/*.png``: three minutes.
``--operate`` takes ``docs/operate/pictures/*.png`` instead: the page in tracking, a fit, a night,
and a critical alarm: two minutes. ``--report FILE.html`` takes the picture of a report of ``pyrcal
commission``, such as the one of tests/system/test_commission.py.
It needs Debian's chromium and chromium-driver, selenium and Pillow.
"""

from __future__ import annotations

import io
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
from PIL import Image
from selenium import webdriver

from pyrcal_studies.shared import free_port, study_parser

ROOT = Path(__file__).parents[1]
PICTURES = ROOT / "docs" / "start"
OPERATE = ROOT / "docs" / "operate" / "pictures"
TINY = ROOT / "tests" / "data" / "tiny"
SMALL = ROOT / "tests" / "system" / "small.toml"
ALARM_AT_S = 90
"""Loop time at which the slopes of the demo for the operating pages stop changing."""

SIZE = (1280, 860)
N_COLOURS = 48
"""A page of few colours: a picture stays below 100 kB."""

JUMP = "0.25,-0.1,0.15,0"
"""As the tutorial has it."""

PATIENCE_S = 400.0


def main() -> int:
    """Take the pictures; return the exit status."""
    parser = study_parser("pyrcal_studies.screenshots", __doc__)
    parser.add_argument("--operate", action="store_true", help="those of the operating pages")
    parser.add_argument("--report", type=Path, metavar="FILE.html", help="of pyrcal commission")
    parser.add_argument(
        "--jump-at", type=float, default=90.0, metavar="S", help="later on a slow machine (90)"
    )
    given = parser.parse_args()
    if given.report:
        with browser() as driver:
            driver.get(given.report.absolute().as_uri())
            picture(driver, "commissioning", OPERATE)
        return 0
    (OPERATE if given.operate else PICTURES).mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        port, zenoh_port = free_port(), free_port()
        words = ["--port", str(port), "--zenoh-port", str(zenoh_port), "--dir", f"{folder}/demo"]
        words += (
            ["--instrument", str(SMALL), "--near", "--fault", f"frozen@{ALARM_AT_S}:60"]
            if given.operate
            else ["--jump", f"{given.jump_at}:{JUMP}"]
        )
        demo = subprocess.Popen([sys.executable, "-m", "pyrcal.demo", *words])
        try:
            (walk_operating if given.operate else walk)(f"http://127.0.0.1:{port}")
        finally:
            demo.terminate()
            demo.wait(20.0)
    return 0


def walk_operating(url: str) -> None:
    """Take the pictures of the operating pages."""
    client = httpx.Client(base_url=url, timeout=20.0)
    wait(lambda: state(client).get("registration"), "the first estimate")
    with browser() as driver:
        driver.get(url)
        wait(lambda: own_matrix(client), "a matrix of the service in use")
        time.sleep(20.0)  # a chart of a few windows
        picture(driver, "operate", OPERATE)
        press(driver, "m")
        wait(lambda: finds(driver, "#fits tbody tr"), "the list of fits")
        for name, file in (("matrix", "tiny.h5"), ("instrument", "tiny.toml")):
            driver.find_element("css selector", f"[name={name}]").send_keys(str(TINY / file))
        driver.find_element("css selector", "#fit [type=submit]").click()
        wait(lambda: finds(driver, "#found .maps canvas"), "the figures of the fit")
        driver.execute_script("document.querySelector('#found').scrollIntoView()")
        time.sleep(1.0)
        picture(driver, "fit", OPERATE)
        press(driver, "y")
        wait(lambda: finds(driver, "#past .plot canvas"), "the night")
        time.sleep(3.0)
        picture(driver, "history", OPERATE)
        press(driver, "o")
        wait(lambda: "slopes-stand" in alarms(client), "the alarm")
        time.sleep(2.0)
        picture(driver, "alarm", OPERATE, height_px=460)


def press(driver: webdriver.Chrome, key: str) -> None:
    """Press a key on the page."""
    driver.find_element("css selector", "body").send_keys(key)


def finds(driver: webdriver.Chrome, selector: str) -> bool:
    """Return whether the page has such an element."""
    return bool(driver.find_elements("css selector", selector))


def alarms(client: httpx.Client) -> set[str]:
    """Return the names of the alarms that last."""
    return {one["name"] for one in state(client).get("alarms", ())}


def walk(url: str) -> None:
    """Do what the tutorial says, and keep what is seen."""
    client = httpx.Client(base_url=url, timeout=20.0)
    wait(lambda: state(client).get("registration"), "the first estimate")
    with browser() as driver:
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


@contextmanager
def browser() -> Iterator[webdriver.Chrome]:
    """Yield a headless browser."""
    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or shutil.which("chromium-browser") or ""
    for word in ("headless=new", "no-sandbox", "disable-dev-shm-usage", "disable-gpu"):
        options.add_argument(f"--{word}")
    driver = webdriver.Chrome(options, webdriver.ChromeService(shutil.which("chromedriver")))
    size = {"width": SIZE[0], "height": SIZE[1], "deviceScaleFactor": 1, "mobile": False}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    try:
        yield driver
    finally:
        driver.quit()


def picture(
    driver: webdriver.Chrome, name: str, folder: Path = PICTURES, height_px: int = SIZE[1]
) -> None:
    """Keep what is seen, in few colours."""
    seen = Image.open(io.BytesIO(driver.get_screenshot_as_png())).convert("RGB")
    seen = seen.crop((0, 0, SIZE[0], height_px))
    path = folder / f"{name}.png"
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


def own_matrix(client: httpx.Client, n_modes: int | None = None) -> bool:
    """Return whether a matrix of this service, of so many modes, is in use."""
    answer = client.get("/v1/reconstructors/in-use")
    found = answer.json() if answer.is_success else {}
    return bool(found.get("parent") and n_modes in {None, found.get("n_modes")})


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


if __name__ == "__main__":
    raise SystemExit(main())

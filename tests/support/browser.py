"""The operator's page in a headless browser: what is seen, and what an operator does there."""

import shutil
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.support.night import wait_for
from tests.support.pace import patience

webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
errors = pytest.importorskip("selenium.common.exceptions", reason="selenium is not installed")
Keys = webdriver.Keys

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
DRIVER = shutil.which("chromedriver")
AXE = Path(__file__).parents[1] / "data" / "axe" / "axe.min.js"
AT_REST = """
const [element, done] = arguments;
const place = () => JSON.stringify(element.getBoundingClientRect());
const before = place();
setTimeout(() => done(element.isConnected && place() === before), 50);
"""
WIDE, LAPTOP, NARROW = (1440, 900), (1280, 800), (390, 844)

NEEDS_A_BROWSER = pytest.mark.skipif(
    CHROMIUM is None or DRIVER is None, reason="no chromium and chromedriver: apt install them"
)


@contextmanager
def a_browser():
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for word in ("headless=new", "no-sandbox", "disable-dev-shm-usage", "disable-gpu"):
        options.add_argument(f"--{word}")
    driver = webdriver.Chrome(options, webdriver.ChromeService(DRIVER))
    driver.set_script_timeout(patience(10.0))
    driver.set_page_load_timeout(patience(20.0))
    try:
        yield driver
    finally:
        driver.quit()


class Page:
    """The page as an operator sees it, and what an operator does with it."""

    def __init__(self, driver, url, system):
        self.driver, self.url, self.system = driver, url, system

    def open(self, size=WIDE):
        self.resize(size)
        self.driver.get("about:blank")  # another view alone would not load it anew
        self.driver.get(self.url)
        known = f"document.title.includes({self.system!r})"
        self.until(f"document.querySelector('#lost').hidden && {known}")

    def turn(self, view):
        """Turn to another view, without loading anything anew."""
        self.js(f"void (location.hash = {view!r})")
        self.until(f"document.querySelector('main#{view}').checkVisibility()")

    def resize(self, size):
        """Give the page itself this size, narrower than a window can be."""
        metrics = {"width": size[0], "height": size[1], "deviceScaleFactor": 1, "mobile": False}
        self.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)

    def offline(self, is_so):
        """Cut the browser off from the service, or end that."""
        self.driver.execute_cdp_cmd("Network.enable", {})
        conditions = {"latency": 0, "downloadThroughput": -1, "uploadThroughput": -1}
        conditions["offline"] = is_so
        self.driver.execute_cdp_cmd("Network.emulateNetworkConditions", conditions)

    def js(self, script):
        return self.driver.execute_script(f"return {script}")

    def until(self, condition, timeout_s=10.0):
        def why():
            return f"{condition}; {self.text()}"

        return wait_for(lambda: self.js(condition), timeout_s, why, every_s=0.05)

    def text(self, selector="body"):
        return self.js(f"document.querySelector({selector!r}).innerText")

    def says(self, selector, words, timeout_s=10.0):
        found = f"document.querySelector({selector!r}).innerText.includes({words!r})"
        self.until(found, timeout_s)

    def click(self, selector):
        """Click what stands still: drawn anew or moved meanwhile it would get nothing of it."""
        self._at_rest(selector, lambda element: element.click())

    def enter(self, selector):
        """Press the enter key on it."""
        self._at_rest(selector, lambda element: element.send_keys("\n"))

    def _at_rest(self, selector, act):
        def done():
            try:
                element = self.driver.find_element("css selector", selector)
                if not element.is_displayed():
                    return False
                if not self.driver.execute_async_script(AT_REST, element):
                    return False
                act(element)
            except (errors.NoSuchElementException, errors.StaleElementReferenceException):
                return False
            return True

        wait_for(done, 10.0, lambda: f"{selector} at rest; {self.text()}", every_s=0.02)

    def press(self, keys):
        """Type with whatever has the focus, once it takes keys: a dialog may be closing."""

        def typed():
            try:
                self.driver.switch_to.active_element.send_keys(keys)
            except (
                errors.ElementNotInteractableException,
                errors.StaleElementReferenceException,
            ):
                return False
            return True

        wait_for(typed, 5.0, lambda: f"something that takes keys; {self.text()}", every_s=0.02)

    def dialog(self, *words):
        """Wait until a dialog is open that says this: what is pressed before goes nowhere."""
        self.until("document.querySelector('#order').open")
        for word in words:
            self.says("#order", word)

    def send(self, keys=""):
        """Type, and send what the dialog asks for by its key."""
        self.press(f"{keys}{Keys.CONTROL}{Keys.ENTER}{Keys.NULL}")

    def cut_off(self):
        """Return what is wider than its room: tables scrolled sideways, parts of the header."""
        found = self.js(
            "[...document.querySelectorAll('header *, main:not([hidden]) .scrolls')]"
            ".filter(e => e.checkVisibility() && e.scrollWidth > e.clientWidth + 1"
            " && getComputedStyle(e).display !== 'inline')"
            ".map(e => e.id || e.ariaLabel || e.outerHTML.slice(0, 60))"
        )
        width = self.js("[document.documentElement.scrollWidth, innerWidth]")
        return found if width[0] <= width[1] else [*found, "the page"]

    def faults_of_access(self):
        """Return what axe-core finds, all of its rules."""
        self.driver.execute_script(AXE.read_text(encoding="utf-8"))
        found = self.driver.execute_async_script(
            "const done = arguments[0]; axe.run().then(r => done(r.violations.map("
            "v => [v.id, v.help, v.nodes.map(n => n.target.join(' '))])))"
        )
        return [fault for fault in found if fault]

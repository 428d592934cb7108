"""The manual in a headless browser, with the headers under which the service shows it."""

import threading
from contextlib import contextmanager

import pytest
import uvicorn
from fastapi import FastAPI

from service.web import page
from tests.support.browser import AXE, NARROW, NEEDS_A_BROWSER, Page, a_browser
from tests.support.night import wait_for

pytestmark = [pytest.mark.system, pytest.mark.long, pytest.mark.timeout(300), NEEDS_A_BROWSER]

WIDE = (1400, 900)
SEEN = [
    "index",
    "start/concepts",
    "tutorials/oopao",
    "reference/cli",
    "operate/runbook",
]
"""A page of each kind: cards, figures, tables, code, generated reference."""


@pytest.fixture(scope="module")
def manual(tmp_path_factory):
    """Address of the manual, served by the functions that the service uses."""
    if not (page.MANUAL / "index.html").is_file():
        pytest.skip("the manual has not been built: make docs")
    app = FastAPI()
    page.install(app)
    server = uvicorn.Server(uvicorn.Config(app, port=0, log_level="warning"))
    thread = threading.Thread(target=server.run)
    thread.start()
    wait_for(lambda: server.started, 20.0)
    port = server.servers[0].sockets[0].getsockname()[1]
    yield f"http://127.0.0.1:{port}/manual"
    server.should_exit = True
    thread.join()


@pytest.fixture(scope="module")
def browser():
    with a_browser() as driver:
        yield driver


@contextmanager
def opened(browser, url, size, theme):
    reader = Page(browser, url, "")
    reader.resize(size)
    browser.get("about:blank")
    browser.get(url.partition("/manual")[0] + "/manual/search.html")
    reader.js(
        f"void (localStorage.setItem('mode', {theme!r}), localStorage.setItem('theme', {theme!r}))"
    )
    browser.get(url)
    reader.until("document.readyState === 'complete'")
    yield reader


@pytest.mark.parametrize("name", SEEN)
def test_no_page_scrolls_sideways(manual, browser, name):
    for size in (WIDE, NARROW):
        with opened(browser, f"{manual}/{name}.html", size, "light") as reader:
            assert reader.js("document.documentElement.scrollWidth") <= size[0], size


@pytest.mark.parametrize("theme", ["light", "dark"])
@pytest.mark.parametrize("name", SEEN)
def test_letters_have_the_contrast_of_aa(manual, browser, name, theme):
    with opened(browser, f"{manual}/{name}.html", WIDE, theme) as reader:
        assert reader.js("document.documentElement.dataset.theme") == theme
        browser.execute_script(AXE.read_text("utf-8"))
        found = browser.execute_async_script(
            "const done = arguments[0];"
            "axe.run(document, {runOnly: ['color-contrast']}).then(r => done(r.violations"
            ".flatMap(v => v.nodes.map(n => n.target + ' ' + n.failureSummary))))"
        )
        assert found == []


def test_the_service_refuses_nothing_that_a_page_needs(manual, browser):
    """Icons, theme and search work under the Content-Security-Policy, without another host."""
    with opened(browser, f"{manual}/index.html", WIDE, "light") as reader:
        browser.get_log("browser")
        reader.js("void document.querySelector('.theme-change-button[data-mode=dark]').click()")
        reader.until("document.documentElement.dataset.theme === 'dark'")
        names = reader.js("performance.getEntriesByType('resource').map(e => e.name)")
        assert names
        assert all(name.startswith(manual) for name in names)
        browser.get(f"{manual}/search.html?q=misregistration")
        reader.until("document.querySelectorAll('#search-results li').length > 5", 20.0)
        refused = [
            line for line in browser.get_log("browser") if "Content Security" in line["message"]
        ]
        assert refused == []
        icons = "f => f.family.includes('Font Awesome') && f.status === 'loaded'"
        reader.until(f"[...document.fonts].some({icons})")

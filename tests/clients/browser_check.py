#!/usr/bin/env python3
"""Opens a page in headless Chromium and waits until it shows a text; prints as JSON what the page did.

Speaks the DevTools protocol, so that a page with an open event stream is no trouble. The browser can
reach this machine only: a page that needs the internet shows up in `foreign_requests` or not at all.
With --do it has hands, too. Steps, in order: `wait:TEXT`, `gone:TEXT`, `click:SELECTOR`, `fill:SELECTOR=TEXT`,
`key:KEY`, `eval:JS`, `shot:OUT.png`, `pause:SECONDS`, `ready:` (prints `ready {..}` on stderr: the caller may act).
--axe runs axe-core on what stands in the end, and lists what it finds.

Exit code: 0 seen, 1 not seen in time or the page threw, 77 no browser here (a test may skip).
"""

import argparse
import base64
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path
from urllib.parse import urlsplit

import websocket

BROWSERS = ("chromium", "google-chrome", "google-chrome-stable", "chromium-browser")
FLAGS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-default-apps",
    "--disable-extensions",
    "--disable-dev-shm-usage",
    "--hide-scrollbars",
    "--remote-debugging-port=0",
    "--remote-allow-origins=*",
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1, EXCLUDE localhost",
]
START_LIMIT_S = 30
SKIPPED = 77


def find_browser():
    for name in (os.environ.get("EMBERFIX_BROWSER"), *BROWSERS):
        if name and (path := shutil.which(name)):
            # Ubuntu's package is a script that only says where the snap is.
            works = subprocess.run([path, "--version"], capture_output=True, check=False)
            if works.returncode == 0:
                return path
    return None


def profile_parent(browser):
    """A snap cannot write to /tmp."""
    if "/snap/" in os.path.realpath(browser) or browser.startswith("/snap/"):
        parent = Path.home() / "snap" / "chromium" / "common"
        parent.mkdir(parents=True, exist_ok=True)
        return parent
    return None


class Page:
    """The one tab of a browser, over its DevTools socket."""

    def __init__(self, profile, window):
        self.port = self._wait_for_port(profile)
        self.socket = websocket.create_connection(self._page_url(), timeout=START_LIMIT_S)
        self.next_id = 0
        self.errors = []
        self.console = []
        self.requests = []
        width, height = window.size
        for method in ("Page.enable", "Runtime.enable", "Log.enable", "Network.enable"):
            self.call(method)
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=window.phone,
        )
        scheme = {"name": "prefers-color-scheme", "value": window.scheme}
        self.call("Emulation.setEmulatedMedia", features=[scheme])

    @staticmethod
    def _wait_for_port(profile):
        """The browser writes the port that it took into its profile."""
        file = Path(profile) / "DevToolsActivePort"
        end = time.monotonic() + START_LIMIT_S
        while time.monotonic() < end:
            if file.exists() and (lines := file.read_text().splitlines()):
                return int(lines[0])
            time.sleep(0.05)
        raise TimeoutError("the browser did not start")

    def _page_url(self):
        end = time.monotonic() + START_LIMIT_S
        opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
        while time.monotonic() < end:
            with opener.open(f"http://127.0.0.1:{self.port}/json/list") as response:
                for target in json.load(response):
                    if target["type"] == "page":
                        return target["webSocketDebuggerUrl"]
            time.sleep(0.05)
        raise TimeoutError("the browser opened no page")

    def call(self, method, **params):
        self.next_id += 1
        self.socket.send(json.dumps({"id": self.next_id, "method": method, "params": params}))
        while True:
            message = json.loads(self.socket.recv())
            if message.get("id") == self.next_id:
                if "error" in message:
                    raise RuntimeError(f"{method}: {message['error']}")
                return message["result"]
            self._note(message)

    def _note(self, event):
        params = event.get("params", {})
        match event.get("method"):
            case "Runtime.exceptionThrown":
                details = params["exceptionDetails"]
                self.errors.append(details.get("exception", {}).get("description") or details["text"])
            case "Runtime.consoleAPICalled":
                words = [str(a.get("value", a.get("description", ""))) for a in params["args"]]
                self.console.append(f"{params['type']}: {' '.join(words)}")
            case "Log.entryAdded":
                entry = params["entry"]
                self.console.append(f"{entry['level']}: {entry['text']}")
            case "Network.requestWillBeSent":
                self.requests.append(params["request"]["url"])

    def evaluate(self, expression):
        result = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in result:
            raise RuntimeError(result["exceptionDetails"]["text"])
        return result["result"].get("value")

    def text(self):
        """What a person can read, the words inside SVG too."""
        return self.evaluate(
            "document.body ? document.body.innerText + '\\n' + "
            "[...document.querySelectorAll('svg text')].map(t => t.textContent).join('\\n') : ''"
        )

    def wait_until(self, holds, limit_s):
        """Whether it held in time."""
        end = time.monotonic() + limit_s
        while not (held := holds(self.text())) and time.monotonic() < end:
            time.sleep(0.02)
        return held

    def key(self, key):
        text = {"text": key} if len(key) == 1 else {}
        self.call("Input.dispatchKeyEvent", type="keyDown", key=key, **text)
        self.call("Input.dispatchKeyEvent", type="keyUp", key=key)

    def element(self, selector, then):
        """Does something with the first element that can be seen; says whether there was one."""
        found = f"[...document.querySelectorAll({json.dumps(selector)})].find(e => e.checkVisibility())"
        return self.evaluate(f"(() => {{ const e = {found}; if (!e) return false; {then}; return true; }})()")

    def wait_for(self, expected, limit_s):
        """How long each text took to appear; those that did not are absent."""
        began = time.monotonic()
        seen = {}
        while len(seen) < len(expected) and time.monotonic() - began < limit_s:
            text = self.text()
            for wanted in expected:
                if wanted not in seen and wanted in text:
                    seen[wanted] = round(time.monotonic() - began, 3)
            time.sleep(0.05)
        return seen

    def screenshot(self, path):
        data = self.call("Page.captureScreenshot", format="png")["data"]
        Path(path).write_bytes(base64.b64decode(data))


class Hands:
    """Does one step after the other; a step that can't be done ends it."""

    def __init__(self, page, limit_s):
        self.page, self.limit_s, self.done = page, limit_s, []

    def run(self, steps):
        return all(self.step(step) for step in steps)

    def step(self, step):
        what, _, rest = step.partition(":")
        value = getattr(self, what)(rest)
        self.done.append({"step": step, "value": value, "unix_s": time.time()})
        return value is not False

    def wait(self, text):
        return self.page.wait_until(lambda seen: text in seen, self.limit_s)

    def gone(self, text):
        return self.page.wait_until(lambda seen: text not in seen, self.limit_s)

    def click(self, selector):
        end = time.monotonic() + self.limit_s
        while not (clicked := self.page.element(selector, "e.click()")) and time.monotonic() < end:
            time.sleep(0.05)
        return clicked

    def fill(self, rest):
        selector, _, text = rest.rpartition("=")
        then = f"e.value = {json.dumps(text)}; e.dispatchEvent(new Event('input', {{bubbles: true}}))"
        return self.page.element(selector, then)

    def key(self, key):
        self.page.key(key)

    def eval(self, expression):
        value = self.page.evaluate(expression)
        return "false" if value is False else value

    def shot(self, path):
        self.page.screenshot(path)

    def pause(self, seconds):
        time.sleep(float(seconds))

    def ready(self, _):
        print("ready {}", file=sys.stderr, flush=True)


def violations(page, source):
    """What axe-core finds, in short; its source goes past the page's own rules on scripts."""
    page.evaluate(Path(source).read_text() + "; undefined")
    found = page.evaluate(
        "axe.run(document, {resultTypes: ['violations']}).then(r => r.violations.map(v => "
        "({id: v.id, impact: v.impact, help: v.help, nodes: v.nodes.map(n => n.html.slice(0, 160) + ' ' + "
        "(n.any[0]?.message ?? ''))})))"
    )
    return found


def foreign(requests, url):
    """What was asked of any other place than the page's own."""
    own = urlsplit(url).netloc
    places = {request: urlsplit(request) for request in requests}
    return sorted(r for r, at in places.items() if at.scheme not in ("data", "blob") and at.netloc != own)


def look(browser, args):
    with tempfile.TemporaryDirectory(
        prefix="emberfix-browser-", dir=profile_parent(browser), ignore_cleanup_errors=True
    ) as profile:
        process = subprocess.Popen(
            [browser, *FLAGS, f"--user-data-dir={profile}", "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        try:
            page = Page(profile, args)
            opened = page.call("Page.navigate", url=args.url)
            seen = page.wait_for(args.expect, args.seconds)
            hands = Hands(page, args.seconds)
            did_all = hands.run(args.do)
            found = violations(page, args.axe) if args.axe else None
            values = {expression: page.evaluate(expression) for expression in args.eval}
            if args.screenshot:
                page.screenshot(args.screenshot)
            return {
                "ok": len(seen) == len(args.expect)
                and did_all
                and not found
                and not page.errors
                and not opened.get("errorText"),
                "url": args.url,
                "load_error": opened.get("errorText"),
                "seen_after_s": seen,
                "not_seen": [t for t in args.expect if t not in seen],
                "title": page.evaluate("document.title"),
                "text": page.text(),
                "values": values,
                "steps": hands.done,
                "violations": found,
                "errors": page.errors,
                "console": page.console,
                "foreign_requests": foreign(page.requests, args.url),
                "screenshot": args.screenshot,
            }
        finally:
            process.terminate()
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def size(text):
    width, height = text.split("x")
    return int(width), int(height)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    add = parser.add_argument
    add("url")
    add("--expect", action="append", default=[], metavar="TEXT", help="text to wait for; may come again")
    add("--seconds", type=float, default=20.0, help="how long to wait for it")
    add("--eval", action="append", default=[], metavar="JS", help="an expression whose value to report")
    add("--screenshot", metavar="OUT.png")
    add("--do", action="append", default=[], metavar="STEP", help="see above; may come again")
    add("--axe", metavar="FILE", help="axe-core's axe.min.js")
    add("--window", dest="size", type=size, default=(1280, 800), metavar="WxH")
    add("--scheme", choices=["light", "dark"], default="light")
    add("--phone", action="store_true")
    args = parser.parse_args()
    browser = find_browser()
    if not browser:
        print("ready {}", file=sys.stderr, flush=True)
        print(json.dumps({"ok": False, "skipped": "no Chromium or Chrome found"}))
        sys.exit(SKIPPED)
    result = look(browser, args)
    print(json.dumps(result, indent=2))
    sys.exit(0 if result["ok"] else 1)


if __name__ == "__main__":
    main()

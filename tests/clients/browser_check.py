#!/usr/bin/env python3
"""Opens a page in headless Chromium and waits until it shows a text; prints as JSON what the page did.

Speaks the DevTools protocol, so that a page with an open event stream is no trouble. The browser can
reach this machine only: a page that needs the internet shows up in `foreign_requests` or not at all.
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
        width, height = window
        for method in ("Page.enable", "Runtime.enable", "Log.enable", "Network.enable"):
            self.call(method)
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )

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
            page = Page(profile, args.window)
            opened = page.call("Page.navigate", url=args.url)
            seen = page.wait_for(args.expect, args.seconds)
            values = {expression: page.evaluate(expression) for expression in args.eval}
            if args.screenshot:
                page.screenshot(args.screenshot)
            return {
                "ok": len(seen) == len(args.expect) and not page.errors and not opened.get("errorText"),
                "url": args.url,
                "load_error": opened.get("errorText"),
                "seen_after_s": seen,
                "not_seen": [t for t in args.expect if t not in seen],
                "title": page.evaluate("document.title"),
                "text": page.text(),
                "values": values,
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
    add("--window", type=size, default=(1280, 800), metavar="WxH")
    args = parser.parse_args()
    browser = find_browser()
    if not browser:
        print(json.dumps({"ok": False, "skipped": "no Chromium or Chrome found"}))
        sys.exit(SKIPPED)
    result = look(browser, args)
    print(json.dumps(result, indent=2))
    sys.exit(0 if result["ok"] else 1)


if __name__ == "__main__":
    main()

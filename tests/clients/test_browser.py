"""The browser check on a small page of our own that learns its text from an event stream."""

import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest
from browser_check import find_browser
from conftest import run

PAGE = b"""<!doctype html><title>fires</title><p id="p">waiting</p>
<svg width="100" height="20"><text y="15">12 m</text></svg>
<script>
new EventSource("/events").onmessage = e => document.getElementById("p").textContent = e.data;
if (location.search === "?throw") throw new Error("boom");
if (location.search === "?tiles") fetch("http://tiles.example/1.png").catch(() => {});
</script>"""


class Handler(BaseHTTPRequestHandler):
    def do_GET(self):
        self.send_response(200)
        events = self.path == "/events"
        self.send_header("Content-Type", "text/event-stream" if events else "text/html")
        self.end_headers()
        if not events:
            self.wfile.write(PAGE)
            return
        time.sleep(0.5)
        self.wfile.write(b"data: FIRE 7\n\n")
        self.wfile.flush()
        self.server.closing.wait(60)  # the stream stays open

    def log_message(self, *_):
        pass


@pytest.fixture
def url():
    if not find_browser():
        pytest.skip("no Chromium or Chrome found")
    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    server.closing = threading.Event()
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}/"
    server.closing.set()
    server.shutdown()


def test_waits_for_the_event_stream(url, tmp_path):
    picture = tmp_path / "page.png"
    result = run("browser_check", url, "--expect", "FIRE 7", "--expect", "12 m", "--screenshot", picture)
    assert result["ok"] and result["not_seen"] == []
    assert result["title"] == "fires"
    assert result["foreign_requests"] == []
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_what_is_not_there_is_not_seen(url):
    result = run("browser_check", url, "--expect", "FIRE 8", "--seconds", 1.5, rc=1)
    assert result["not_seen"] == ["FIRE 8"]


def test_a_page_that_throws_fails(url):
    result = run("browser_check", url + "?throw", "--expect", "FIRE 7", rc=1)
    assert "boom" in result["errors"][0]


def test_a_call_abroad_is_named(url):
    result = run("browser_check", url + "?tiles", "--expect", "FIRE 7")
    assert result["foreign_requests"] == ["http://tiles.example/1.png"]

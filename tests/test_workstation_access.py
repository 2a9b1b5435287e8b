"""Who may come in: the token on every interface, TLS, and requests that no browser sends."""

from __future__ import annotations

import shutil
import socket
import subprocess
import sys
import urllib.error
import urllib.request
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest

pytest.importorskip("trame_slicer", reason="the workstation comes with: pip install '.[serve]'")
pytest.importorskip("playwright", reason="browser tests need playwright: pip install '.[test]'")

from tests.served import refused
from tests.test_workstation import browser as browser, pixels, pytestmark as pytestmark, settled

needs_openssl = pytest.mark.skipif(shutil.which("openssl") is None, reason="OpenSSL makes the certificate")


@pytest.fixture(scope="module")
def certificate(tmp_path_factory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("tls")
    cert, key = folder / "cert.pem", folder / "key.pem"
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-keyout", key, "-out", cert, "-days", "2",
         "-subj", "/CN=localhost"],
        check=True, capture_output=True,
    )  # fmt: skip
    return cert, key


class Server:
    """`ussim serve` as a process."""

    def __init__(self, *arguments) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "SlicerUSSim.Command.cli", "serve", "--port", "0", *map(str, arguments)],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        self.url = self.process.stdout.readline().strip()
        self.port = urlsplit(self.url).port
        self.token = urlsplit(self.url).query.partition("=")[2]

    def answer(self, request: str) -> str:
        """The first line of the answer to a request in HTTP's own words."""
        with socket.create_connection(("127.0.0.1", self.port), timeout=60) as connection:
            connection.sendall(request.replace("\n", "\r\n").encode())
            return connection.recv(200).decode(errors="replace").partition("\r\n")[0]

    def page(self, request: str) -> str:
        """The whole answer to a request after which the connection is closed."""
        with socket.create_connection(("127.0.0.1", self.port), timeout=60) as connection:
            connection.sendall(request.replace("\n", "\r\n").encode())
            return b"".join(iter(lambda: connection.recv(2**16), b"")).decode()

    def end(self) -> str:
        """What it wrote to its log."""
        self.process.terminate()
        return self.process.communicate(timeout=60)[1]


@pytest.fixture(scope="module")
def server(files):
    """A server on loopback, which has written no traceback when it is ended."""
    server = Server("--labels", files / "labels.nii.gz")
    yield server
    log = server.end()
    assert "Traceback" not in log and "Error" not in log, log


@pytest.mark.slow
def test_only_the_token_opens_the_door_on_loopback_too(server, browser):
    """Other users of the computer can connect to it."""
    assert len(server.token) >= 32
    base = f"http://127.0.0.1:{server.port}/"
    for path in ("", "index.html", "ws", "?token=wrong"):
        with pytest.raises(urllib.error.HTTPError) as caught:
            urllib.request.urlopen(f"{base}{path}", timeout=60)
        assert caught.value.code == 403
    with_cookies = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())
    with with_cookies.open(f"{base}?token={server.token}", timeout=60) as answer:
        assert answer.status == 200 and server.token not in answer.url  # nor in the history
        assert answer.headers["X-Content-Type-Options"] == "nosniff"
        assert "frame-ancestors 'none'" in answer.headers["Content-Security-Policy"]
        assert answer.headers["Referrer-Policy"] == "no-referrer"
    # A name that another site makes resolve to this computer, and pages of other sites
    for headers in (
        "Host: elsewhere.example",
        f"Host: 127.0.0.1:{server.port}\nOrigin: http://elsewhere.example",
    ):
        answer = server.answer(f"GET /?token={server.token} HTTP/1.1\n{headers}\n\n")
        assert answer.split()[1] == "403"
    refused = server.page("GET / HTTP/1.1\nHost: <script>alert(1)</script>\nConnection: close\n\n")
    assert " 403 " in refused and "&lt;script&gt;" in refused and "<script>" not in refused
    intruder = browser.new_page()
    intruder.goto(f"{base}?token=wrong")
    assert "token is missing or wrong" in intruder.locator("#reason").inner_text()
    intruder.close()


@pytest.mark.slow
def test_requests_that_no_browser_sends_leave_no_traceback(server):
    host, token = f"127.0.0.1:{server.port}", server.token
    socket_of = f"GET /ws?token={token} HTTP/1.1\nHost: {host}\n"
    upgrade = "Upgrade: websocket\nConnection: Upgrade\nSec-WebSocket-Version: "
    assert server.answer("\x16\x03\x01garbage\n\n").split()[1] == "400"
    assert server.answer(f"{socket_of}\n").split()[1] == "400"
    assert server.answer(f"{socket_of}{upgrade}99\nSec-WebSocket-Key: x\n\n").split()[1] == "400"
    assert server.answer(f"{socket_of}{upgrade}13\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\n\n\x01hello") != ""
    assert server.answer("GET / HTTP/1.1\nHost: [\n\n").split()[1] in ("400", "403")
    assert server.answer(f"GET / HTTP/1.1\nHost: {host}\nOrigin: http://[x\n\n").split()[1] == "403"
    for port in ("99999999", "x", "-1"):
        for path in ("/", f"/?token={token}"):
            answer = server.page(f"GET {path} HTTP/1.1\nHost: 127.0.0.1:{port}\nConnection: close\n\n")
            assert answer.split()[1] == "403" and "The request was not understood" in answer
    for line in (f"GET /{'a' * 9000} HTTP/1.1\nHost: {host}", f"GET / HTTP/1.1\nHost: {host}\nX: {'a' * 9000}"):
        assert server.answer(f"{line}\n\n").split()[1] == "400"
    assert server.answer(f"GET /?token={token} HTTP/1.1\nHost: {host}\n\n").split()[1] == "303"  # it still answers


@needs_openssl
@pytest.mark.long
def test_with_a_certificate_page_and_images_come_over_tls(browser, files, certificate):
    cert, key = certificate
    server = Server("--labels", files / "labels.nii.gz", "--cert", cert, "--key", key)
    try:
        assert server.url.startswith("https://")
        page = browser.new_page(ignore_https_errors=True)
        page.set_default_timeout(120_000)
        sockets = []
        page.on("websocket", lambda socket: sockets.append(socket.url))
        page.goto(server.url)
        page.wait_for_function("window.ussim?.images > 0")
        settled(page)
        assert sockets and all(address.startswith("wss://") for address in sockets)
        assert np.mean(pixels(page)) > 3
        (cookie,) = [entry for entry in page.context.cookies() if "ussim_token" in entry["name"]]
        assert cookie["secure"] and cookie["httpOnly"]
        page.close()
    finally:
        server.end()


@pytest.mark.slow
@needs_openssl
def test_what_is_not_a_certificate_is_reported_in_one_line(files, certificate):
    labels = files / "labels.nii.gz"
    cert, _ = certificate
    for arguments, words in (
        (["--cert", cert], "--cert and --key are for each other, expected both or none"),
        (["--cert", cert, "--key", cert], "expected a certificate and its key"),
    ):
        assert words in refused("--labels", labels, *arguments)

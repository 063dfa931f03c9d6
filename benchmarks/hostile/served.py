"""Hostile requests to the operator's page, many to one server: forms, uploads, addresses and tokens."""

from __future__ import annotations

import contextlib
import http.client
import os
import re
import shutil
import signal
import time
from collections.abc import Mapping
from pathlib import Path
from urllib.parse import quote, urlencode

from hostile import archives, clothes, logs, stores
from hostile.cage import Case
from hostile.oracles import OUTSIDE, secrets_in
from hostile.values import ESCAPES, Rng, number, pick, text

REQUESTS = 40
"""Requests to one server, which takes seconds to start and to end."""

_TOKEN = "the-token-of-the-operators-0123"
_STARTS, _ANSWERS = 40.0, 20.0
"""Seconds within which a server must start, and answer a request."""


def case(rng: Rng, folder: Path, base: Path) -> Case:
    """Make a server of a rig, whose store is sometimes hostile, and the requests to it."""
    sound = bool(rng.random() < 0.8)
    if sound:
        shutil.copy(base / clothes.TABLE, folder / clothes.TABLE)
    else:
        stores.crafted(rng, folder, base / clothes.TABLE)
        (folder / stores.NAME).rename(folder / clothes.TABLE)
    protected = bool(rng.random() < 0.5)

    def client(child: int, place: Path, printed: Path) -> bytes:
        try:
            return _session(rng, place, printed, child, protected, sound)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.kill(child, signal.SIGINT)

    environment = {"CTXVAL_TOKEN": _TOKEN} if protected else {}
    return Case(("serve", clothes.TABLE, "--port", "0"), environment=environment, client=client)


def _session(rng: Rng, place: Path, printed: Path, child: int, protected: bool, sound: bool) -> bytes:
    """Send requests, and return the answers; a line that begins with ! says what is wrong with one."""
    ends = time.monotonic() + _STARTS
    while (found := re.search(rb":(\d+)/", printed.read_bytes() if printed.exists() else b"")) is None:
        if time.monotonic() > ends or os.waitid(os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT):
            return b"!status: the server does not start" if sound else b""
        time.sleep(0.05)
    server = _Server(int(found[1]), protected)
    answers = []
    for _ in range(REQUESTS):
        status, content = server.request(rng, place)
        wrong = _wrong(status, content, server.admitted)
        answers += [content, *(f"!{one} after {server.last}".encode() for one in wrong)]
    return b"\n".join(answers)


def _wrong(status: int, content: bytes, admitted: bool) -> list[str]:
    wrong = [f"secret: {name} in an answer" for name in secrets_in(content)]
    wrong += [f"status: the server answers {status}"] if status >= 500 and status != 503 else []
    wrong += ["hang: the server does not answer"] if status == 0 else []
    wrong += ["traceback: in an answer"] if b"Traceback (most recent" in content else []
    return wrong + (["other answer: no token was needed"] if not admitted and b"trial 2" in content else [])


class _Server:
    """A browser without manners.

    Args:
        port: the port of the server.
        protected: whether it needs a token.
    """

    def __init__(self, port: int, protected: bool) -> None:
        self.port, self.protected, self.admitted = port, protected, True
        self.last, self._cookie, self._token = "", "", ""
        self._enter()

    def _enter(self) -> None:
        status, content = self._send("GET", f"/?token={_TOKEN}" if self.protected else "/", b"", {})
        if self._cookie:
            status, content = self._send("GET", "/", b"", {"Cookie": self._cookie})
        found = re.search(rb'name="token" value="([0-9a-f]+)"', content)
        self._token = found[1].decode() if status == 200 and found is not None else ""

    def request(self, rng: Rng, place: Path) -> tuple[int, bytes]:
        """Send one request; return its status, 0 if there is no answer in time, and the answer with its headers."""
        if not self._token:
            self._enter()
        self.admitted = not self.protected or rng.random() < 0.9
        headers = {"Origin": f"http://127.0.0.1:{self.port}", "Sec-Fetch-Site": "same-origin"}
        headers |= {"Cookie": self._cookie} if self.admitted else {}
        if rng.random() < 0.1:
            odd = {"Host": text(rng, 200), "Origin": "http://evil", "Cookie": text(rng, 500), "Content-Length": "9"}
            name = str(pick(rng, tuple(odd)))
            headers[name] = odd[name]
        kind = int(rng.integers(6))
        if kind == 0:
            return self._send("GET", _address(rng), b"", headers)
        if kind in (1, 2):
            fields = _fields(rng, self._token)
            headers["Content-Type"] = "application/x-www-form-urlencoded"
            body = urlencode(fields, errors="replace").encode()
            return self._send("POST", str(pick(rng, _FORMS)), body, headers)
        if kind == 3 and rng.random() < 0.5:
            return self._send(text(rng, 20), _address(rng), rng.bytes(200), headers)
        body, boundary = self._upload(rng, place)
        headers["Content-Type"] = f"multipart/form-data; boundary={boundary}"
        return self._send("POST", f"/trials/{rng.integers(4)}/recording", body, headers)

    def _upload(self, rng: Rng, place: Path) -> tuple[bytes, str]:
        """Return the form of a recording that is hostile, or that is in other clothes."""
        aside = place.parent / "client" / "f"
        shutil.rmtree(aside, ignore_errors=True)
        (aside / "home").mkdir(parents=True)
        made = logs.MAKERS[int(rng.integers(len(logs.MAKERS)))](rng, aside)[0]
        content = b""
        if (aside / made).is_file() and not (aside / made).is_symlink() and (aside / made).stat().st_size < 2**22:
            # The links in it lead to the decoys beside the server.
            content = (aside / made).read_bytes().replace(b"/client/f/../outside", b"/outside")
        elif rng.random() < 0.5:
            content = archives.npz(rng)
        shutil.rmtree(aside.parent, ignore_errors=True)
        name = str(
            pick(rng, (made, made, f"../{made}", f"{OUTSIDE}/{made}", text(rng, 100) + made, str(pick(rng, ESCAPES))))
        )
        name = name.replace("\r", "").replace("\n", "")
        fields = {"token": self._token, "tolerance": str(pick(rng, ("1e9", "", number(rng)))), "resample": "1"}
        parts = [
            f'--edge\r\nContent-Disposition: form-data; name="{key}"\r\n\r\n{value}\r\n'.encode()
            for key, value in fields.items()
        ]
        head = f'--edge\r\nContent-Disposition: form-data; name="file"; filename="{name}"\r\n\r\n'
        whole = b"".join([*parts, head.encode("utf-8", "replace"), content, b"\r\n--edge--\r\n"])
        return (whole if rng.random() < 0.9 else whole[: int(rng.integers(len(whole)))]), "edge"

    def _send(self, method: str, path: str, body: bytes, headers: Mapping[str, str]) -> tuple[int, bytes]:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=_ANSWERS)
        method = re.sub(r"[^!-~]", "x", method) or "X"
        self.last = f"{method[:20]} {path[:100]!r} {len(body)} bytes"
        try:
            connection.putrequest(method, path, skip_host="Host" in headers, skip_accept_encoding=True)
            given = {"Content-Length": str(len(body)), **headers}
            for name, value in given.items():
                connection.putheader(name, re.sub(r"[^ -~]", "x", value))
            connection.endheaders(body or None)
            if path.startswith("/events"):
                connection.sock.settimeout(0.5)
            answer = connection.getresponse()
            self._cookie = (answer.getheader("set-cookie") or self._cookie).partition(";")[0]
            content = b"" if path.startswith("/events") else answer.read()
            return answer.status, f"{answer.getheaders()}".encode() + content
        except TimeoutError:
            # A body that is shorter than it says is waited for.
            return (0 if headers.get("Content-Length") is None and not path.startswith("/events") else 408), b""
        except (OSError, http.client.HTTPException, ValueError):
            return 400, b""
        finally:
            connection.close()


_FORMS = ("/choose", "/trials/2/distance", "/trials/2/failure", "/trials/1/failure", "/enter", "/trials/99/distance")


def _address(rng: Rng) -> str:
    path = str(
        pick(
            rng,
            (
                *(
                    "/",
                    "/?all",
                    f"/?token={quote(text(rng, 50), errors='replace')}",
                    f"/?told={number(rng)}",
                    "/events",
                ),
                *("/trials/2/files.zip", "/trials/2/files/task.json", "/trials/2/files/..%2f..%2ftable.sqlite"),
                *("/trials/2/files/%2e%2e/x", "/static/../app.py", "/static/..%2fapp.py", "/static/page.js"),
                *("/pictures/largest.svg", "/pictures/..%2f..%2fx.svg", f"/{quote(text(rng, 600), errors='replace')}"),
                *(f"/trials/{number(rng)}/files.zip", "//etc/passwd", "/%00", "/home/.netrc"),
            ),
        )
    )
    return re.sub(r"[^!-~]", "x", path)


def _fields(rng: Rng, token: str) -> dict[str, str]:
    fields = {"token": token if rng.random() < 0.9 else text(rng, 50), "seen": str(pick(rng, (3, number(rng))))}
    fields["how"] = str(pick(rng, ("next", "draw", "own", "again", text(rng, 30))))
    fields |= {f"parameter-{k}": str(pick(rng, (1.0, 0.1, number(rng)))) for k in range(2)}
    fields |= {"trial": str(pick(rng, (0, number(rng)))), "because": text(rng, 300), "distance": str(number(rng))}
    fields |= {"reason": text(rng, 3000), "submission": text(rng, 50), text(rng, 50): text(rng, 50)}
    return fields

"""Attacks on a server of this machine, over raw sockets, bounded in number and time.

usage: guard.py PORT PROCESS [few_files] [tell]. Prints what failed, then "N passed, M failed"; with tell also memory and the
worst probe at each step.
"""
import json
import os
import re
import socket
import sys
import threading
import time

PORT, PROCESS = int(sys.argv[1]), int(sys.argv[2])
KB, MB = 1 << 10, 1 << 20
HOST = b"Host: x\r\n"
JSON = b"Content-Type: application/json\r\n"
LIVE = b"GET /health/live HTTP/1.1\r\n" + HOST + b"\r\n"
passed = failed = 0


def check(name, ok, found=""):
    global passed, failed
    if ok:
        passed += 1
    else:
        failed += 1
        print(f"FAILED: {name}\n        {str(found)[:600]}", flush=True)


def connect(timeout=10.0, receive=None):
    s = socket.socket()
    if receive:
        s.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive)
    s.settimeout(timeout)
    s.connect(("127.0.0.1", PORT))
    return s


def send(s, data):
    """Sends until the server closes; how many bytes it took."""
    sent = 0
    try:
        while sent < len(data):
            sent += s.send(data[sent:sent + 65536])
    except OSError:
        pass
    return sent


def read(s):
    """All bytes until the server closes or the timeout."""
    data = b""
    try:
        while True:
            more = s.recv(65536)
            if not more:
                return data, True
            data += more
    except ConnectionResetError:
        return data, True
    except OSError:
        return data, False


def answers(data, heads=False):
    """[(status, headers, body)] of what came back."""
    found = []
    while data.startswith(b"HTTP/1.1 "):
        head, _, data = data.partition(b"\r\n\r\n")
        lines = head.decode("latin1").split("\r\n")
        headers = {k.lower(): v.strip() for k, v in (line.split(":", 1) for line in lines[1:])}
        status = int(lines[0].split()[1])
        if status == 100:
            continue
        length = 0 if heads else int(headers.get("content-length", 0))
        found.append((status, headers, data[:length]))
        data = data[length:]
    return found


def talk(*parts, timeout=10.0, end=False, heads=False):
    """What is answered to these bytes, whether the server closed, and after how long the first answer came."""
    s = connect(timeout)
    begin = time.monotonic()
    for part in parts:
        send(s, part)
    if end:
        s.shutdown(socket.SHUT_WR)
    first = b""
    try:
        first = s.recv(65536)
    except OSError:
        pass
    seconds = time.monotonic() - begin
    data, closed = read(s) if first else (b"", True)
    s.close()
    return answers(first + data, heads), closed, seconds


def is_problem(status, headers, body):
    try:
        problem = json.loads(body)
    except ValueError:
        return False
    return (headers.get("content-type") == "application/problem+json" and problem["status"] == status
            and problem["type"].startswith("/problems/") and problem["title"] and problem["detail"]
            and isinstance(problem["instance"], str) and problem["request_id"] == headers.get("x-request-id")
            and not re.search(rb"/usr/|/home/|/tmp/|\.cpp|std::|httplib|terminate|exception", body))


def refused(name, status, *parts, within=1.0, closed=True, end=False):
    """One answer, a problem of that status, at once; and the connection ends."""
    found, was_closed, seconds = talk(*parts, timeout=4.0 if closed else 0.5, end=end)
    statuses = status if isinstance(status, tuple) else (status,)
    check(name, len(found) == 1 and found[0][0] in statuses and is_problem(*found[0]), (found, seconds))
    check(f"{name}: at once", seconds < within, seconds)
    if closed:
        check(f"{name}: closed", was_closed, found)
        check(f"{name}: says that it closes", found and found[0][1].get("connection") == "close", found)


def memory(key="VmRSS"):
    with open(f"/proc/{PROCESS}/status") as status:
        return int(re.search(key + r":\s+(\d+) kB", status.read())[1]) * KB


def probe():
    """How long /health/live takes on a new connection; none if it is not answered."""
    begin = time.monotonic()
    try:
        s = connect(5.0)
        s.sendall(LIVE)
        ok = s.recv(4096).startswith(b"HTTP/1.1 200 ")
        s.close()
    except OSError:
        ok = False
    return time.monotonic() - begin if ok else float("inf")


def lives(name, limit=1.0):
    """The worst of ten probes."""
    worst = max(probe() for _ in range(10))
    if "tell" in sys.argv:
        print(f"{name}: {memory() / MB:.1f} MB now, {memory('VmHWM') / MB:.1f} MB at most, {worst * 1000:.1f} ms")
    check(f"{name}: a probe is answered within {limit} s", worst < limit, worst)
    return worst


def get(target, *headers, version=b"HTTP/1.1", method=b"GET"):
    return method + b" " + target + b" " + version + b"\r\n" + HOST + b"".join(h + b"\r\n" for h in headers) + b"\r\n"


def post(*headers, path=b"/v1/fits"):
    return b"POST " + path + b" HTTP/1.1\r\n" + HOST + JSON + b"".join(h + b"\r\n" for h in headers) + b"\r\n"


def heads():
    refused("a header of 400 KB", 431, b"GET / HTTP/1.1\r\n" + HOST + b"X: " + b"x" * (400 * KB))
    refused("a request line of 400 KB", 414, b"GET /" + b"x" * (400 * KB))
    refused("a request line of 9 KB", 414, get(b"/" + b"x" * 9 * KB))
    refused("1 MB of short headers", 431, b"GET / HTTP/1.1\r\n" + HOST + b"A: b\r\n" * 170000)
    refused("101 headers", 431, get(b"/", *[b"A%d: b" % i for i in range(100)]))
    found, _, _ = talk(get(b"/health/live", *[b"A%d: b" % i for i in range(98)], b"Connection: close"))
    check("100 headers are served", found and found[0][0] == 200, found)
    for name, header in [("duplicate Content-Length", b"Content-Length: 2\r\nContent-Length: 2"),
                         ("two different Content-Length", b"Content-Length: 2\r\nContent-Length: 3"),
                         ("a list of lengths", b"Content-Length: 2, 2"), ("a signed length", b"Content-Length: +2"),
                         ("a negative length", b"Content-Length: -2"), ("a hexadecimal length", b"Content-Length: 0x2"),
                         ("an empty length", b"Content-Length: "), ("a blank before the colon", b"Content-Length : 2"),
                         ("a folded header", b"Content-Length: 2\r\n Folded: yes"), ("a nameless header", b": x"),
                         ("a line without a colon", b"Content-Length: 2\r\nnonsense"),
                         ("Content-Length and Transfer-Encoding", b"Content-Length: 2\r\nTransfer-Encoding: chunked"),
                         ("two Transfer-Encodings", b"Transfer-Encoding: chunked\r\nTransfer-Encoding: chunked"),
                         ("two Hosts", b"Content-Length: 2\r\nHost: y"), ("a NUL byte", b"Content-Length: 2\r\nX: \0"),
                         ("a bare CR", b"Content-Length: 2\r\nX: a\rb"), ("a bare LF", b"Content-Length: 2\nX: a")]:
        refused(name, 400, post(header) + b"{}" + LIVE)
    refused("no Host", 400, b"GET /health/live HTTP/1.1\r\n\r\n" + LIVE)
    refused("an encoding there is not", 501, post(b"Transfer-Encoding: gzip, chunked") + b"0\r\n\r\n")
    refused("chunks in HTTP/1.0", 400, b"POST /v1/fits HTTP/1.0\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n")
    for name, line in [("two parts", b"GET /"), ("one part", b"GET"), ("a blank in the target", b"GET / / HTTP/1.1"),
                       ("no version", b"GET / FTP"), ("control characters", b"GET /\x01 HTTP/1.1"),
                       ("bytes above ASCII", b"GET /\xff HTTP/1.1"), ("TLS", b"\x16\x03\x01\x02\0\x01"),
                       ("%00", b"GET /%00 HTTP/1.1"), ("a bad escape", b"GET /%zz HTTP/1.1"),
                       ("a cut escape", b"GET /% HTTP/1.1"), ("a fragment", b"GET /#a HTTP/1.1"),
                       ("no path", b"GET x HTTP/1.1"), ("a method of none", b"G(T / HTTP/1.1")]:
        refused(f"a request line: {name}", 400, line + b"\r\n" + HOST + b"\r\n")
    for method in (b"PROPFIND", b"get", b"TRACE", b"CONNECT", b"PRI"):
        refused(f"method {method.decode()}", 501, get(b"/", method=method))
    refused("HTTP/2", 505, get(b"/", version=b"HTTP/2.0"))
    refused("another expectation", 417, post(b"Content-Length: 2", b"Expect: the best"))
    for target in (b"/v1%2fmodels", b"/v1/models%2Fward", b"/v1/../v1/nothing", b"/v1/%2e%2e/etc/passwd", b"//", b"/v1/models/..%2f..%2fetc%2fpasswd"):
        refused(f"target {target.decode()}", 404, get(target, b"Connection: close"))
    found, _, _ = talk(get(b"http://any.host:8080/health/live", b"Connection: close"))
    check("an absolute target", found and found[0][0] == 200, found)
    found, _, _ = talk(get(b"http://any.host", b"Connection: close"))
    check("an absolute target without a path", found and found[0][0] == 200, found)
    found, _, _ = talk(b"\r\n\r\n" + get(b"/health/live", b"Connection: close"))
    check("empty lines before a request", found and found[0][0] == 200, found)
    found, _, _ = talk(get(b"/v1/models?a=b?c", b"Connection: close"))
    check("a ? in the query", found and found[0][0] in (200, 422), found)
    found, closed, _ = talk(b"GET /health/live HTTP/1.0\r\n\r\n")
    check("HTTP/1.0: one answer, closed", len(found) == 1 and found[0][0] == 200 and closed, found)
    found, closed, _ = talk(b"GET /health/live HTTP/1.0\r\nConnection: keep-alive\r\n\r\n" * 2, timeout=0.5)
    check("HTTP/1.0 that stays", len(found) == 2 and not closed and found[0][1]["connection"] == "keep-alive", found)
    found, _, _ = talk(get(b"/health/live", b"Connection: close", method=b"HEAD"), heads=True)
    check("HEAD", len(found) == 1 and found[0][0] == 200 and int(found[0][1]["content-length"]) > 0, found)
    found, _, _ = talk(LIVE, end=True)
    check("a client that has closed its side is answered", found and found[0][0] == 200, found)
    found, closed, _ = talk(LIVE * 3, timeout=0.5)
    check("three pipelined requests: three answers", [f[0] for f in found] == [200] * 3 and not closed, found)
    found, _, _ = talk(post(b"Content-Length: 2") + b"{}" + LIVE, timeout=0.5)
    check("a request behind a body", [f[0] for f in found] == [422, 200], found)
    found, _, _ = talk(get(b"/health/live", b"Content-Length: 60") + LIVE.ljust(60, b" ")[:60], timeout=0.5)
    check("the body of a GET is no request", len(found) == 1, found)
    found, _, _ = talk(get(b"/v1/models", b"Range: bytes=" + b",".join(b"0-%d" % i for i in range(1300)),
                           b"Connection: close"))
    check("1300 ranges are passed over", found and found[0][0] == 200 and found[0][1]["accept-ranges"] == "none", found)
    found, _, _ = talk(get(b"/v1/models", b"Range: nonsense", b"Connection: close"))
    check("a bad range is passed over", found and found[0][0] == 200, found)
    found, _, _ = talk(get(b"/v1/models", b"Accept-Encoding: gzip, br", b"Connection: close"))
    check("answers are sent as they are", found and "content-encoding" not in found[0][1], found)


def bodies():
    refused("POST without a length", 411, post())
    refused("a length beyond the cap", 413, post(b"Content-Length: 33554433"))
    refused("a length of 26 digits", 413, post(b"Content-Length: " + b"9" * 26))
    refused("a length beyond the cap, expecting 100", 413, post(b"Content-Length: 33554433", b"Expect: 100-continue"))
    refused("gzip", 415, post(b"Content-Encoding: gzip", b"Content-Length: 995000"))
    found, _, _ = talk(b"POST /v1/fits HTTP/1.1\r\n" + HOST + b"Content-Type: application/x-www-form-urlencoded\r\n"
                       b"Content-Length: 9000\r\nConnection: close\r\n\r\n" + b"x" * 9000)
    check("a form", found and found[0][0] == 415 and "accept-post" in found[0][1] and is_problem(*found[0]), found)
    chunked = post(b"Transfer-Encoding: chunked")
    for name, body in [("a chunk size that is none", b"xyz\r\n"), ("a negative chunk", b"-1\r\n"),
                       ("a chunk without its end", b"2\r\n{}xx\r\n"), ("a bare LF", b"2\n{}\r\n0\r\n\r\n"),
                       ("a line without end", b"1;" + b"x" * 5000), ("an empty size", b"\r\n")]:
        refused(f"chunks: {name}", 400, chunked + body)
    refused("a chunk of 2^60 bytes", 413, chunked + b"1000000000000000\r\n")
    refused("a chunk of 2^80 bytes", 413, chunked + b"1" + b"0" * 20 + b"\r\n")
    refused("400 MB in chunks", 413, chunked + (b"100000\r\n" + b" " * MB + b"\r\n") * 40, within=5.0)
    found, _, _ = talk(post(b"Transfer-Encoding: chunked", b"Connection: close") +
                       b"1;a=b\r\n{\r\n0001\r\n}\r\n0\r\nTrailer: x\r\n\r\n")
    check("good chunks", found and found[0][0] == 422, found)
    s = connect()
    s.sendall(post(b"Content-Length: 2", b"Expect: 100-continue", b"Connection: close"))
    first = s.recv(4096)
    s.sendall(b"{}")
    found = answers(read(s)[0])
    check("100 Continue, then the answer", first == b"HTTP/1.1 100 Continue\r\n\r\n" and found and found[0][0] == 422,
          (first, found))


def hold(count, first, receive=None):
    """So many sockets that have sent this; those the server does not take are left out."""
    sockets = []
    for _ in range(count):
        try:
            s = connect(2.0, receive)
            s.sendall(first)
            sockets.append(s)
        except OSError:
            pass
    return sockets


def drip(sockets, seconds, byte=b"x"):
    """A byte each now and then, in the background."""
    end = time.monotonic() + seconds

    def run():
        while time.monotonic() < end:
            for s in sockets:
                try:
                    s.send(byte)
                except OSError:
                    pass
            time.sleep(0.2)
    thread = threading.Thread(target=run)
    thread.start()
    return thread


def closing(sockets, seconds):
    """How many the server has closed within so many seconds, and what the first said."""
    end = time.monotonic() + seconds
    left, said, count = set(sockets), b"", 0
    while left and time.monotonic() < end:
        for s in list(left):
            s.settimeout(0.001)
            try:
                data = s.recv(65536)
                if data:
                    said = said or data
                    continue
                left.discard(s)
                count += 1
            except (TimeoutError, BlockingIOError):
                pass
            except OSError:
                left.discard(s)
                count += 1
    return count, answers(said)


def numbers():
    slow = hold(300, b"GET /health/live HTTP/1.1\r\nHost: x\r\nX: ")
    dripping = drip(slow, 6.5)
    lives("300 slow heads")
    slow_bodies = hold(300, post(b"Content-Length: 1000000"))
    lives("300 slow heads and 300 slow bodies")
    begin = time.monotonic()
    count, said = closing(slow, 8.0)
    check("slow heads are closed, whatever drips", count == len(slow) == 300, (count, len(slow)))
    check("... with 408", said and said[0][0] in (408, 503) and is_problem(*said[0]), said)
    dripping.join()
    lives("300 slow bodies")
    for s in slow + slow_bodies:
        s.close()

    idle = []
    begin = time.monotonic()
    idle = hold(1500, b"")
    check("1500 connections are made in seconds", time.monotonic() - begin < 6.0, time.monotonic() - begin)
    lives("1500 idle connections")
    shed = b""
    for s in idle:
        s.settimeout(0.0)
        try:
            shed = shed or s.recv(65536)
        except OSError:
            pass
    said = answers(shed)
    check("those that are shed hear 503", said and said[0][0] == 503 and is_problem(*said[0]), said)
    check("... and when to come again", said and said[0][1].get("retry-after", "").isdigit(), said)
    for s in idle:
        s.close()

    # Bodies of as many bytes as the service takes, at once: it makes them wait, and the rest is served. No reader of
    # bodies is at this path.
    large = []
    for _ in range(6):
        s = connect()
        s.setblocking(False)
        try:
            s.send(post(b"Content-Length: 33554432", path=b"/v1/nothing"))
        except OSError:
            pass
        large.append(s)
    end = time.monotonic() + 2
    while time.monotonic() < end:
        for s in large:
            try:
                s.send(b" " * 65536)
            except OSError:
                pass
    lives("200 MB of bodies")
    for s in large:
        s.close()

    # Clients that ask and do not read.
    deaf = hold(100, get(b"/v1/models") * 40, receive=4096)
    lives("100 clients that do not read")
    for s in deaf:
        s.close()


def few_files():
    idle = hold(150, b"")
    lives("more connections than file descriptors")
    for s in idle:
        s.close()
    time.sleep(0.3)
    lives("... and afterwards", 0.5)


if "few_files" in sys.argv:
    few_files()
else:
    for path in (b"/health/ready", b"/v1", b"/v1/models"):  # the first waits for the last self-test
        talk(get(path, b"Connection: close"))
    before = memory()
    with open(f"/proc/{PROCESS}/clear_refs", "w") as refs:
        refs.write("5")  # the peak counts from here
    heads(); lives("after heads")
    bodies(); lives("after bodies")
    numbers()
    time.sleep(0.5)
    grown, peak = memory() - before, memory("VmHWM") - before
    check("the memory grows by less than 64 MB at any time", peak < 64 * MB, f"{peak / MB:.1f} MB")
    print(f"memory: +{grown / MB:.1f} MB, at most +{peak / MB:.1f} MB; a probe takes {probe() * 1000:.1f} ms")
print(f"{passed} passed, {failed} failed")

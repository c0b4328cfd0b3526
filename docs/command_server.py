"""The program ``strapdown`` for the pages of a build, without its start: a server that has it loaded forks for each call.

``start(folder)`` writes a ``strapdown`` into a folder, for PATH, and starts the server. A call passes its arguments, folder, environment
and standard streams over a socket, runs :func:`strapdown.cli.main` in a fork, and ends with its exit status.
"""

from __future__ import annotations

import atexit
import contextlib
import io
import json
import os
import socket
import stat
import subprocess
import sys
import tempfile
import time
from pathlib import Path

CLIENT = """\
import array, json, os, socket, sys
call = socket.socket(socket.AF_UNIX)
call.connect({address!r})
words = json.dumps({{"arguments": sys.argv[1:], "folder": os.getcwd(), "environment": dict(os.environ)}}).encode()
call.sendmsg([len(words).to_bytes(4, "big")], [(socket.SOL_SOCKET, socket.SCM_RIGHTS, array.array("i", [0, 1, 2]))])
call.sendall(words)
sys.exit(int(call.recv(16)))
"""


def start(folder: Path) -> None:
    """Write the program into a folder and start its server, which ends with this process."""
    address, client, program = (str(folder / name) for name in ("socket", "client.py", "strapdown"))
    Path(client).write_text(CLIENT.format(address=address), encoding="utf-8")
    Path(program).write_text(f'#!/bin/sh\nexec "{sys.executable}" -I -S "{client}" "$@"\n', encoding="utf-8")
    Path(program).chmod(Path(program).stat().st_mode | stat.S_IXUSR)
    server = subprocess.Popen([sys.executable, __file__, address])
    atexit.register(server.wait)
    atexit.register(server.terminate)  # runs first
    while not Path(address).exists():
        if server.poll() is not None:
            raise RuntimeError("the server of the program for the pages has ended")
        time.sleep(0.05)


def _warm() -> None:
    """Load modules and compiled code by a first use, as a notebook that has run for a while would have."""
    from strapdown import cli

    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for words in ("simulate two-stars", "estimate two-stars.h5 --figures", "check estimate-results/estimate.h5"):
            sys.argv = ["strapdown", *words.split()]
            nowhere = io.StringIO()
            with (
                contextlib.redirect_stdout(nowhere),
                contextlib.redirect_stderr(nowhere),
                contextlib.suppress(SystemExit),
            ):
                cli.main()


def _serve(address: str) -> None:
    _warm()
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(address)
    listener.listen()
    while True:
        call, _ = listener.accept()
        if os.fork() == 0:
            _answer(call)
        call.close()
        with contextlib.suppress(ChildProcessError):
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass


def _answer(call: socket.socket) -> None:
    """Run the program in a fork of this fork, so that its exit status is known whatever it does; end this one."""
    head, streams, _, _ = socket.recv_fds(call, 4, 3)
    length, words = int.from_bytes(head, "big"), b""
    while len(words) < length:
        words += call.recv(length - len(words))
    child = os.fork()
    if child == 0:
        for number, stream in enumerate(streams):
            os.dup2(stream, number)
        sys.stdout, sys.stderr = (io.TextIOWrapper(io.FileIO(number, "w", closefd=False)) for number in (1, 2))
        request = json.loads(words)
        os.chdir(request["folder"])
        os.environ.clear()
        os.environ.update(request["environment"])
        sys.argv = ["strapdown", *request["arguments"]]
        from strapdown import cli

        status = 0
        try:
            cli.main()
        except SystemExit as done:
            status = done.code if isinstance(done.code, int) else int(done.code is not None)
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    call.sendall(str(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])).encode())
    os._exit(0)


if __name__ == "__main__":
    _serve(sys.argv[1])

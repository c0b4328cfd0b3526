"""The program ``strapdown`` and the kernels of the pages, without their start: a server that has the package loaded forks for each.

``start(folder)`` writes a ``strapdown`` into a folder, for PATH, and a kernel ``python3``, for JUPYTER_PATH, and starts the server. A call
passes its arguments, folder, environment and standard streams over a socket, runs :func:`strapdown.cli.main` or the kernel in a fork, and
ends with its exit status. A page finds in its kernel what it would find in a new one, only sooner.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import io
import json
import os
import select
import shlex
import signal
import socket
import stat
import subprocess
import sys
import tempfile
import time
from pathlib import Path

CLIENT = """\
import array, json, os, signal, socket, sys
signal.signal(signal.SIGINT, signal.SIG_IGN)  # sent to a kernel before its end is requested
call = socket.socket(socket.AF_UNIX)
call.connect({address!r})
words = json.dumps({{"arguments": sys.argv[1:], "folder": os.getcwd(), "environment": dict(os.environ)}}).encode()
call.sendmsg([len(words).to_bytes(4, "big")], [(socket.SOL_SOCKET, socket.SCM_RIGHTS, array.array("i", [0, 1, 2]))])
call.sendall(words)
sys.exit(int(call.recv(16)))
"""


def start(folder: Path) -> None:
    """Write program and kernel into a folder and start their server, which ends with this process."""
    address, client, program = (str(folder / name) for name in ("socket", "client.py", "strapdown"))
    Path(client).write_text(CLIENT.format(address=address), encoding="utf-8")
    begin = [sys.executable, "-I", "-S", client]
    Path(program).write_text(f'#!/bin/sh\nexec {shlex.join(begin)} strapdown "$@"\n', encoding="utf-8")
    Path(program).chmod(Path(program).stat().st_mode | stat.S_IXUSR)
    kernel = folder / "kernels/python3/kernel.json"
    kernel.parent.mkdir(parents=True)
    words = {"argv": [*begin, "kernel", "-f", "{connection_file}"], "display_name": "Python 3", "language": "python"}
    kernel.write_text(json.dumps(words), encoding="utf-8")
    server = subprocess.Popen([sys.executable, __file__, address], stdin=subprocess.PIPE, start_new_session=True)
    atexit.register(server.communicate)  # the end of its input is the server's end, also if this process is killed
    while not Path(address).exists():
        if server.poll() is not None:
            raise RuntimeError("the server of the program for the pages has ended")
        time.sleep(0.05)


def _warm() -> None:
    """Load modules and compiled code by a first use, as a notebook that has run for a while would have."""
    os.environ["MPLBACKEND"] = "module://matplotlib_inline.backend_inline"  # a kernel would set it, too late
    import ipykernel.ipkernel  # noqa: F401
    import matplotlib.pyplot  # noqa: F401

    from strapdown import cli

    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for words in (
            "simulate two-stars",
            "estimate two-stars.h5 --figures",
            "check estimate-results/estimate.h5",
            "montecarlo two-stars --runs 8",
        ):
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
    gc.freeze()  # no fork need look through what is here
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(address)
    listener.listen()
    while True:
        if sys.stdin in select.select([listener, sys.stdin], [], [])[0]:
            os.killpg(0, signal.SIGKILL)  # with all forks
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
        sys.argv = request["arguments"]
        from ipykernel import kernelapp

        from strapdown import cli

        status = 0
        try:
            {"strapdown": cli.main, "kernel": kernelapp.launch_new_instance}[sys.argv[0]]()
        except SystemExit as done:
            status = done.code if isinstance(done.code, int) else int(done.code is not None)
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    call.sendall(str(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])).encode())
    os._exit(0)


if __name__ == "__main__":
    _serve(sys.argv[1])

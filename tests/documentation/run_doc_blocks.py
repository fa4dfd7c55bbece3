"""Run blocks of one page of the documentation one after the other, as a reader would; see test_doc_blocks.py.

Reads a JSON list of [place, language, text or commands] from the standard input. All blocks share one process, which
saves starting torch anew for each, and Python blocks go on where the one before ended.
"""

import json
import shlex
import signal
import subprocess
import sys
import urllib.request

SERVER_SECONDS = 240


def run_command(command: str) -> None:
    """One line of a block of commands. Only `carts` is known here; what else a page names, it has to mark."""
    program, *arguments = shlex.split(command)
    if program != "carts":
        sys.exit(f"{command!r} is no carts command. Mark the block with <!-- not run: why -->, or test it elsewhere.")
    if arguments[:1] == ["view"]:
        serve(arguments)
        return
    from carts_core.cli import command_line as cli  # noqa: PLC0415  pages without commands do without it

    try:
        cli.main(arguments)
    except SystemExit as end:
        if end.code not in (None, 0):
            sys.exit(f"{command!r} ended with status {end.code}.")


def serve(arguments: list[str]) -> None:
    """Start the viewer, load its page, and end it as Ctrl-C does."""
    server = subprocess.Popen(
        [sys.executable, "-u", "-m", "carts_core.cli", *arguments, "--port", "0"], stdout=subprocess.PIPE, text=True
    )
    try:
        assert server.stdout is not None
        addresses = (word for line in server.stdout for word in line.split() if word.startswith("http://"))
        with urllib.request.urlopen(next(addresses), timeout=SERVER_SECONDS) as answer:
            assert answer.status == 200 and b"<html" in answer.read()
        server.send_signal(signal.SIGINT)
        assert server.wait(SERVER_SECONDS) in (0, 130)
    finally:
        server.kill()


def main() -> None:
    """Run every block; the first failure ends it with a message or a traceback that names the place."""
    namespace = {"__name__": "__main__"}
    for place, language, content in json.load(sys.stdin):
        print(f"--- {place}", flush=True)
        if language == "python":
            exec(compile(content, place, "exec"), namespace)
        else:
            for command in content:
                print(f"$ {command}", flush=True)
                run_command(command)


if __name__ == "__main__":
    main()

"""Runs a command and writes what it took to a pipe: `python -I -S launch.py PIPE COMMAND [ARGUMENT]...`.

It is a process of its own, of a few MB: the peak of memory that the system tells of a child includes what the process
had before it became the command, and so the memory of the process that starts it.
"""

import json
import os
import sys
import time


def main() -> int:
    """Runs the command; its exit code is this process's own."""
    pipe, command = int(sys.argv[1]), sys.argv[2:]
    os.set_inheritable(pipe, False)
    start = time.perf_counter()
    child = os.posix_spawnp(command[0], command, os.environ)
    _, status, usage = os.wait4(child, 0)
    seconds = time.perf_counter() - start
    took = {"wall_s": seconds, "cpu_s": usage.ru_utime + usage.ru_stime, "peak_bytes": 1024 * usage.ru_maxrss}
    os.write(pipe, json.dumps(took).encode())
    return os.waitstatus_to_exitcode(status) % 256


if __name__ == "__main__":
    sys.exit(main())

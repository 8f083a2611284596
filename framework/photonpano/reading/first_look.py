"""Read files in a separate process first: libraries in C may loop, crash or take all memory on damaged ones."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from functools import cache
from pathlib import Path

from photonpano.errors import InputError
from photonpano.reading.files import reading
from photonpano.text import byte_size

CPU_S = 2.0  # seconds of the processor for a small file, imports included
CPU_BYTES_PER_S = 50e6  # a larger file gets a second more for each 50 MB
MEMORY_BYTES = 2 * 1024**3  # address space of the process, beside the size of the largest file
_WAIT_S = 60.0  # seconds to wait beside those of the processor, as for a slow disk
_TOO_MUCH_MEMORY = 99  # exit code of a process that ran out of memory

# The program of the process: it sets its own limits, and prints the number of each file before it reads it.
_PROCESS = f"""
import importlib, os, resource, signal, sys
memory, module, function, *files = sys.argv[1:]
resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
resource.setrlimit(resource.RLIMIT_AS, (int(memory), int(memory)))
signal.signal(signal.SIGINT, signal.SIG_DFL)
def look(number, seconds, path):
    os.write(1, b"%d\\n" % number)
    signal.setitimer(signal.ITIMER_PROF, float(seconds))
    try:
        getattr(importlib.import_module(module), function)(path)
    except MemoryError:
        os._exit({_TOO_MUCH_MEMORY})
    except BaseException:
        pass
for number in range(0, len(files), 2):
    look(number // 2, *files[number:number + 2])
os._exit(0)
"""


def look_first(paths: Path | Sequence[Path], look: str) -> None:
    """Have a process of its own read files, before this one does.

    It has limits of time and memory. What the look raises does not count: the reader itself will raise it, in its own words.
    A file is looked at once, unless it changes. It takes about 0.2 s, most of which the import of the library takes: so look
    at all files of a capture at once.

    Args:
        paths: the file, or the files of a capture. Of thousands, choose some.
        look: the function that reads, `package.module:function`; called with the path as text. It does what the reader will
            do, to some frames that are spread over the file. Its module imports nothing but the library.

    Raises:
        InputError: a file makes the library loop or crash, or takes more memory than a capture may need.

    Example:
        ```python
        look_first(path, "my_plugin.looks:frames")
        with reading(path, "is damaged; copy it again"):
            file = h5py.File(path)
        ```
    """
    files = []
    for path in [paths] if isinstance(paths, Path) else paths:
        with reading(path):
            known = path.stat()
        files.append((str(path), known.st_size, known.st_mtime_ns))
    if files:
        _look(tuple(files), look)


@cache
def _look(files: tuple[tuple[str, int, int], ...], look: str) -> None:
    arguments = [text for path, size, _ in files for text in (str(CPU_S + size / CPU_BYTES_PER_S), path)]
    largest = max(size for _, size, _ in files)
    limits = [str(MEMORY_BYTES + largest), *look.split(":")]
    # As this process finds modules, and without a thread for each core: those take address space.
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    wait_s = _WAIT_S + sum(size for _, size, _ in files) / CPU_BYTES_PER_S
    try:
        with subprocess.Popen(
            [sys.executable, "-P", "-c", _PROCESS, *limits, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=environment,
        ) as process:
            try:
                begun, _ = process.communicate(timeout=wait_s)
            except BaseException as error:
                process.kill()
                if not isinstance(error, subprocess.TimeoutExpired):
                    raise
                begun = process.communicate()[0]
    except OSError:  # no process can be started: the reader goes on without
        return
    if process.returncode and begun:
        path = files[int(begun.split()[-1])][0]
        raise InputError(f"{path} {_verdict(process.returncode, largest)}: it is damaged; copy or record it again")


def _verdict(code: int, largest: int) -> str:
    """Describe the end of a process: by a signal if the code is negative."""
    import signal

    if code == _TOO_MUCH_MEMORY:
        return f"takes more than {byte_size(MEMORY_BYTES + largest)} of memory to read"
    if -code in (signal.SIGPROF, signal.SIGKILL):
        return "cannot be read to an end"
    return f"makes its reader crash ({signal.Signals(-code).name if code < 0 else f'exit code {code}'})"

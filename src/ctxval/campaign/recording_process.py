"""The process that reads a file of a stranger; :mod:`ctxval.campaign.telling` starts this file as a program.

Its argument is the folder of the request, which is a pickle of the process that started this one. Its output is the
trajectory as NPZ, or the reason why there is none: whoever took over this process could not make it more than that.
"""

from __future__ import annotations

import os
import pickle
import sys
from pathlib import Path


def main() -> None:
    """Read the recording with as few rights as possible."""
    # The secrets of the user are often in the environment; where the home lies decides what must not be readable.
    home = {"HOME": os.environ["HOME"]} if "HOME" in os.environ else {}
    os.environ.clear()
    os.environ |= home | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "ARROW_DEFAULT_MEMORY_POOL": "system"}
    sys.path.append(str(Path(__file__).resolve().parents[2]))
    from ctxval._util.cores import limit, read_only
    from ctxval.campaign.telling import REFUSED
    from ctxval.errors import CtxvalError

    supplied, (path, *names), seconds = pickle.loads(Path(sys.argv[1], "request").read_bytes())
    limit(seconds)
    read_only([path])
    try:
        content, status = supplied.read_file(path, *names).to_npz(), 0
    except CtxvalError as error:
        content, status = str(error).encode(errors="replace"), REFUSED
    sys.stdout.buffer.write(content)
    sys.stdout.buffer.flush()
    os._exit(status)  # a library may be damaged, so the process ends without unloading it


if __name__ == "__main__":
    main()

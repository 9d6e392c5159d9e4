"""What this process may use of the machine."""

from __future__ import annotations

import os
import re
import resource
import sys
from pathlib import Path


def core_count() -> int:
    """The cores, as far as the system says so."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def worker_count(asked: int) -> int:
    """How many workers `n_jobs` asks for: so many, or below 0 one for each core but `-1 - n_jobs`."""
    return asked if asked > 0 else max(1, core_count() + 1 + asked)


def file_limit() -> int:
    """How many files this process may have open at once."""
    limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    return sys.maxsize if limit == resource.RLIM_INFINITY else limit


def free_memory() -> int:
    """Bytes that programs can still have; half of all where the system does not say."""
    meminfo = Path("/proc/meminfo")
    known = re.search(r"MemAvailable:\s*(\d+) kB", meminfo.read_text() if meminfo.exists() else "")
    if known is not None:
        return 1024 * int(known[1])
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2

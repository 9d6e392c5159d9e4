"""A process's memory in pages of 2 MB: a fork of it then costs a third, as there are fewer pages to share."""

import ctypes
from pathlib import Path

_SIZE = 2**21
_MADV_COLLAPSE = 25  # from Linux 6.1 on; elsewhere nothing changes


def collapse() -> None:
    """Put what this process has written so far into huge pages, where it fills them."""
    maps = Path("/proc/self/maps")
    if not maps.exists():  # on other systems
        return
    library = ctypes.CDLL(None)
    for line in maps.read_text().splitlines():
        span, rights, _, _, inode, *_ = line.split()
        if rights != "rw-p" or inode != "0":
            continue
        first, end = (int(place, 16) for place in span.split("-"))
        for place in range(-(-first // _SIZE) * _SIZE, end - _SIZE + 1, _SIZE):
            library.madvise(ctypes.c_void_p(place), ctypes.c_size_t(_SIZE), _MADV_COLLAPSE)

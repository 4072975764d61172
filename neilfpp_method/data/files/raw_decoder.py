"""Decode a camera RAW file by LibRaw, as a program: `python raw_decoder.py FILE OUT.npz BYTES`.

LibRaw reads dozens of undocumented formats in C++, and a damaged file can crash it. `data.files.raw`
therefore runs this program in a process of its own, which may allocate BYTES. It imports nothing else of the
package, so that it starts quickly. If the file cannot be decoded, the reason is written to OUT.txt.
"""

from __future__ import annotations

import resource
import sys
from pathlib import Path

import numpy as np

__all__: list[str] = []


def decode(path: str, out: Path) -> None:
    """Write `samples` (H, W, 3), 16 bits, linear, `mosaic`, `white_level` and `camera_balance` of a file."""
    import rawpy

    with rawpy.imread(path) as raw:
        samples = raw.postprocess(
            output_bps=16,
            gamma=(1, 1),
            no_auto_bright=True,
            adjust_maximum_thr=0.0,
            user_wb=list(raw.daylight_whitebalance),
            output_color=rawpy.ColorSpace.sRGB,
            highlight_mode=rawpy.HighlightMode.Clip,
            user_flip=0,
        )
        np.savez(
            out,
            samples=samples,
            mosaic=raw.raw_image_visible,
            white_level=raw.white_level,
            camera_balance=np.array(raw.camera_whitebalance[:3], float),
        )


def _main(path: str, out: Path, memory: int) -> int:
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        decode(path, out)
    except Exception as error:
        # The exceptions of LibRaw and of rawpy have no common base class.
        out.with_suffix(".txt").write_text(str(error) or type(error).__name__, "utf-8", "replace")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(_main(sys.argv[1], Path(sys.argv[2]), int(sys.argv[3])))

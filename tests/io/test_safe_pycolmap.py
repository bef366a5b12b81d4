"""A process that loads pycolmap can write PNGs, and ends in silence when it is told to."""

import signal
import subprocess
import sys

_SCRIPT = """
from ambiguous_wild.io.safe_pycolmap import pycolmap
import os, signal, sys
assert list(sys.modules).index("zlib") < list(sys.modules).index("pycolmap")
pycolmap.Camera(model="PINHOLE", width=4, height=4, params=[1, 1, 2, 2])
import cv2, numpy as np, OpenImageIO as oiio
image = np.random.default_rng(0).integers(0, 256, (200, 300, 3), dtype=np.uint8)
assert cv2.imwrite(sys.argv[1] + "/cv.png", image)
spec = oiio.ImageSpec(300, 200, 3, "uint8")
out = oiio.ImageOutput.create(sys.argv[1] + "/oiio.png")
assert out.open(sys.argv[1] + "/oiio.png", spec) and out.write_image(image)
out.close()
for name in ("cv.png", "oiio.png"):
    assert (np.sort(cv2.imread(sys.argv[1] + "/" + name), 2) == np.sort(image, 2)).all()
print("alive", flush=True)
os.kill(os.getpid(), signal.SIGTERM)
"""


def test_png_writers_survive_pycolmap(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", _SCRIPT, str(tmp_path)], capture_output=True, text=True, check=False
    )
    assert done.stdout.strip() == "alive"
    assert (done.returncode, done.stderr) == (-signal.SIGTERM, "")

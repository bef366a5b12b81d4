"""Make web pages that are one file: fill a template, encode JPEGs and data: addresses."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ambiguous_wild.core.errors import AwError
from ambiguous_wild.io.images import decode, header_size

_PNG_URI = "data:image/png;base64,"
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def fill_page(
    folder: Path,
    data: Mapping[str, object],
    scripts: Sequence[str],
    *,
    title: str = "",
    images: str = "data:",
    more_sources: str = "",
    more_scripts: str = "",
    parts: Mapping[str, str] | None = None,
    sort_keys: bool = False,
) -> str:
    """Fill the template FOLDER/page.html with style, scripts and data; texts are escaped.

    The page's content security policy allows this style, these scripts and the sources given, nothing else.

    Args:
        folder: folder of the template, its style and its scripts.
        data: data for the scripts, as JSON.
        scripts: names of files, in order.
        title: title of the page.
        images: sources of pictures in the policy.
        more_sources: further directives of the policy.
        more_scripts: further sources of scripts in the policy.
        parts: texts for other places /*NAME*/ of the template, by NAME.
        sort_keys: sort the keys of the JSON.
    """
    style = (folder / "page.css").read_text(encoding="utf-8")
    script = "\n".join((folder / name).read_text(encoding="utf-8") for name in scripts)
    text = json.dumps(data, ensure_ascii=False, allow_nan=False, separators=(",", ":"), sort_keys=sort_keys)
    for char in "<>&\u2028\u2029":  # no text in it can end the element it stands in
        text = text.replace(char, f"\\u{ord(char):04x}")
    policy = (
        f"default-src 'none'; img-src {images}; style-src {_digest(style)}; {more_sources}"
        f"script-src {_digest(script)}{more_scripts}; base-uri 'none'; form-action 'none'"
    )
    texts = {"POLICY": policy, "TITLE": html.escape(title), "STYLE": style, "SCRIPT": script, "DATA": text}
    texts |= parts or {}
    # One pass, so that a text which is put in is not searched for places again.
    template = (folder / "page.html").read_text(encoding="utf-8")
    return re.sub(r"/\*([A-Z]+)\*/", lambda place: texts[place[1]], template)


def _digest(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def jpeg_bytes(image: np.ndarray, quality: int, *, full_colour: bool = False) -> bytes:
    """Encode [H, W, 3] uint8 RGB as JPEG without metadata; `full_colour` keeps colours at full resolution.

    Raises:
        AwError: too large for a JPEG.
    """
    import cv2

    flags = [cv2.IMWRITE_JPEG_QUALITY, quality]
    if full_colour:
        flags += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    done, data = cv2.imencode(".jpg", np.ascontiguousarray(image[:, :, ::-1]), flags)
    if not done:  # a side above 65500 px
        raise AwError(f"a picture of {image.shape[1]}x{image.shape[0]} px is too large for a JPEG")
    return data.tobytes()


def narrowed(image: np.ndarray, width: int) -> np.ndarray:
    """Reduce an image [H, W] or [H, W, C] to at most `width` px."""
    import cv2

    if image.shape[1] <= width:
        return image
    height = max(1, round(image.shape[0] * width / image.shape[1]))
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)


def data_uri(kind: str, data: bytes) -> str:
    """Return a data: address of a picture; `kind` is "jpeg" or "png"."""
    return f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"


def png_of(uri: object, max_width: int, max_height: int) -> np.ndarray | None:
    """Decode a data: address of a PNG that may come from a stranger.

    Returns:
        its grey values [H, W] uint8; None if `uri` is no such address, or its picture is larger or damaged.
    """
    import cv2

    if not isinstance(uri, str) or not uri.startswith(_PNG_URI):
        return None
    try:
        data = base64.b64decode(uri.removeprefix(_PNG_URI), validate=True)
    except ValueError:  # also of text that is not ASCII
        return None
    size = header_size(data) if data.startswith(_PNG_SIGNATURE) else None
    if size is None or size[0] > max_width or size[1] > max_height:
        return None
    return decode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE, "a picture of a page")

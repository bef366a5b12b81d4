"""Download a model's files from the Hugging Face hub, checked by the sha256 that the hub states.

A repository without model.safetensors but with pytorch_model.bin, such as the first DINO's, is converted:
torch reads tensors from that file and nothing else (``weights_only``).
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

from ambiguous_wild.core import AwError
from ambiguous_wild.core.errors import shortlist
from ambiguous_wild.core.extras import install_command
from ambiguous_wild.io.atomic import write_json
from ambiguous_wild.io.hashing import sha256_file
from ambiguous_wild.vision.convert import read_as_arrays, save
from ambiguous_wild.vision.weights import Weight

TENSORS, PICKLE, RECEIPT = "model.safetensors", "pytorch_model.bin", "source.json"


def offline() -> str:
    """The variables by which the user has set the hub's library to offline; "" if it is not."""
    on = ("1", "true", "yes", "on")
    names = ("HF_HUB_OFFLINE", "TRANSFORMERS_OFFLINE")
    return " and ".join(name for name in names if os.environ.get(name, "").lower() in on)


def switched_off() -> str:
    """Why nothing is downloaded while `offline`."""
    return f"the hub is switched off by {offline()}"


def download(weight: Weight, folder: Path) -> None:
    """Download the files of the weights into an existing folder, with the commit and hashes in source.json.

    Raises:
        AwError: no network, no such repository or file, another sha256 than the hub states, or a
            pytorch_model.bin that holds more than tensors.
    """
    if offline():
        raise AwError(switched_off())
    try:
        from huggingface_hub import HfApi
    except ImportError:
        raise AwError(f"huggingface_hub is not installed ({install_command('masks')})") from None
    try:
        info = HfApi().model_info(weight.hub_id, files_metadata=True)
        stated = {file.rfilename: file for file in info.siblings or []}
        wanted = [PICKLE if n == TENSORS and TENSORS not in stated else n for n in weight.files]
        missing = [name for name in wanted if name not in stated]
        if not missing:
            for name in wanted:
                _one_file(weight.hub_id, name, info.sha or "main", folder, stated[name])
    except AwError:
        raise
    except Exception as error:  # no network, no permission, no such repository, disk full
        raise AwError(_first_line(error)) from None
    if missing:
        raise AwError(f"{weight.hub_id} on the hub has no {shortlist(missing)}")
    if PICKLE in wanted:
        _convert(folder)
    shutil.rmtree(folder / ".cache", ignore_errors=True)  # the library's notes on the download
    hashes = {name: sha256_file(folder / name) for name in weight.files}
    write_json(folder / RECEIPT, {"hub": weight.hub_id, "commit": info.sha, "sha256": hashes})


def _one_file(hub_id: str, name: str, commit: str, folder: Path, stated: Any) -> None:
    from huggingface_hub import hf_hub_download

    hf_hub_download(hub_id, name, revision=commit, local_dir=folder)
    # the hub states hashes of large files only
    expected = getattr(getattr(stated, "lfs", None), "sha256", None)
    if expected and sha256_file(folder / name) != expected:
        raise AwError(f"{name} of {hub_id} has another sha256 than the hub states; nothing was installed")


def _convert(folder: Path) -> None:
    """pytorch_model.bin to model.safetensors."""
    save(read_as_arrays(folder / PICKLE), folder / TENSORS)
    (folder / PICKLE).unlink()


def _first_line(error: Exception) -> str:
    text = str(error).strip()
    return text.splitlines()[0] if text else type(error).__name__

"""The same bytes of a safetensors file for the same tensors."""

import json
from collections.abc import Mapping

from safetensors.torch import save
from torch import Tensor

_LENGTH = 8
"""The header's own length comes first, and tensors begin at a multiple of it [bytes]."""


def tensor_bytes(tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> bytes:
    """A safetensors file; `safetensors` itself writes metadata in another order every time.

    Args:
        tensors: contiguous, by name.
        metadata: texts for the header, in this order.
    """
    content = save(dict(tensors))
    end = _LENGTH + int.from_bytes(content[:_LENGTH], "little")
    header = {"__metadata__": dict(metadata), **json.loads(content[_LENGTH:end])}
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % _LENGTH)
    return len(text).to_bytes(_LENGTH, "little") + text + content[end:]

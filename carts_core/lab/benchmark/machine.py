"""What measurements were taken on."""

import os
import platform
from pathlib import Path

import torch

from ...wording import counted

_CUDA = "cuda: "


def machine(device: torch.device) -> str:
    """Processor, cores, threads, and the graphics card that networks and solver run on, if they do."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        names = [line.split(":", 1)[1].strip() for line in cpuinfo.read_text().splitlines() if "model name" in line]
        model = names[0] if names else model
    card = f", {_CUDA}{torch.cuda.get_device_name(device)}" if device.type == "cuda" else ""
    return f"{model}, {counted(os.cpu_count() or 1, 'core')}, torch threads: {torch.get_num_threads()}{card}"


def on_gpu(text: str) -> bool:
    """Whether `machine` wrote that a graphics card was used."""
    return _CUDA in text

"""What measurements were taken on."""

import os
import platform
from pathlib import Path

import torch


def machine() -> str:
    """Processor, cores, threads and graphics card, all that seconds depend on."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        names = [line.split(":", 1)[1].strip() for line in cpuinfo.read_text().splitlines() if "model name" in line]
        model = names[0] if names else model
    device = f", {torch.cuda.get_device_name()}" if torch.cuda.is_available() else ""
    return f"{model}, {os.cpu_count()} cores, torch threads: {torch.get_num_threads()}{device}"

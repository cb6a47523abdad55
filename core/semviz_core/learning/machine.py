"""On what something was computed, in words that name nobody's computer."""

import os
import platform
from pathlib import Path

import torch


def describe_machine(device: torch.device, processes: int) -> str:
    """Such as ``AMD EPYC 7B13, 2 cores``, then the GPU, then how many processes if several."""
    words = [_cpu(), f"{os.cpu_count()} cores"]
    if device.type == "cuda":
        words.append(torch.cuda.get_device_name(device))
    if processes > 1:
        words.append(f"{processes} processes")
    return ", ".join(words)


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:  # not Linux
        lines = []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor() or platform.machine())

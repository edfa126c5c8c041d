"""Blocks with memory beside a model: controllers, switches and latches that read it at their ticks and hold what they set."""

from nsmodel.blocks.block import Block, each_step, sampled
from nsmodel.blocks.common import dead_time, delay, hysteresis, latch, pid, thyristor

__all__ = ["Block", "dead_time", "delay", "each_step", "hysteresis", "latch", "pid", "sampled", "thyristor"]

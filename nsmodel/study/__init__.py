"""Work-precision studies: how accurate a scheme is for what it costs."""

from nsmodel.study.lines import Cost, Line, Order, Point
from nsmodel.study.result import Study, StudyInterrupted
from nsmodel.study.work_precision import study

__all__ = ["Cost", "Line", "Order", "Point", "Study", "StudyInterrupted", "study"]

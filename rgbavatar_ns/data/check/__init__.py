"""Whether a dataset can be trained: the whole check with an image, and a quick one."""

from rgbavatar_ns.data.check.problems import Problem
from rgbavatar_ns.data.check.report import (
    CheckReport,
    check_dataset,
    quick_check,
    unreadable_report,
)

__all__ = ["CheckReport", "Problem", "check_dataset", "quick_check", "unreadable_report"]

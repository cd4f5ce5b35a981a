"""Comparison of controllers and policies on one fish: scores, tables and figures."""

from fishd.lab.compare.comparison import Standing, Trace, Verdict, compare, judge_standings
from fishd.lab.compare.live import LiveComparison

__all__ = ["LiveComparison", "Standing", "Trace", "Verdict", "compare", "judge_standings"]

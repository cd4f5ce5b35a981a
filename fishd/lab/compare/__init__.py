"""Contestants against one another: scores, tables and figures."""

from fishd.lab.compare.comparison import Standing, Trace, Verdict, compare, judge_standings
from fishd.lab.compare.live import LiveComparison

__all__ = ["LiveComparison", "Standing", "Trace", "Verdict", "compare", "judge_standings"]

"""Reports and tables of ``torchrg convert``."""

from torchrg.batch.run import BatchReport
from torchrg.batch.task import TaskReport
from torchrg.cli.report import format_report, format_table


def test_depth_frames_are_counted_by_the_second():
    scans = (TaskReport("a", "converted", num_points=640), TaskReport("b", "failed"))
    report = BatchReport(scans, started=0.0, seconds=4.0, engine="local", workers=1)
    reported = "640 points in 4.0 s: 160 points, 0.25 frames a second"
    assert reported in format_report(report, unit="frame")


def test_an_empty_table_is_its_head():
    assert format_table(["scan", "points"], []) == "scan  points"


def test_format_table_by_example():
    assert (format_table(["scan", "points"], [["hall", "1,000"], ["office", "20"]])) == (
        "scan    points\nhall     1,000\noffice      20"
    )

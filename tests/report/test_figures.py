"""The table of figures: its columns, and the formatting of commands."""

from __future__ import annotations

from neilfpp_method.report.tables import figures_section


def test_columns_without_a_figure_are_left_out():
    alone = figures_section({"pbr_psnr": 20.0}, "")
    framed = figures_section({"base_color_psnr": 20.0, "base_color_psnr_frame": 25.0}, "")
    both = figures_section({"base_color_psnr": 20.0, "baseline_base_color_psnr": 15.0, "pbr_psnr": 21.0}, "")
    columns = [section.count('scope="col"') for section in (alone, framed, both)]
    assert columns == [3, 4, 4]
    assert "whole frame" in framed
    assert "naive baseline" not in framed
    assert "naive baseline" in both
    assert both.count("–") == 1  # the second row has no baseline


def test_commands_between_backticks_are_code():
    section = figures_section({"pbr_psnr": 20.0}, "`neilfpp eval <run>` measures those.")
    assert "<code>neilfpp eval &lt;run&gt;</code> measures those." in section
    assert "`" not in section

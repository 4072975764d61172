"""Runs side by side (docs/compare.md).

`contenders` reads what lies in their folders, `common` finds the views that all of them can show, `figures`
and `parts` make the table, `terminal` shows it, `sheet` makes the picture, and `write` does it all.
"""

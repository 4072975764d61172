"""Decide by measurement which effects are simulated for a scene (docs/effects.md).

`catalogue` lists the effects, each a change of settings. `request` parses the option `--effects`. `plan`
records the decisions and derives the settings that follow from them. `review` runs the measurements at the
moments of training when they are cheap; `visibility`, `material` and the other modules implement them.
`table` formats a plan.

Several measurements fit light and materials to places (`places`, `place_data`, `place_fit`). The same fits
give the initial light (`first_light`) and find paint that was taken for metal (`material_search`).
"""

"""Decide by measurement which effects are simulated for a scene (docs/effects.md).

`catalogue` lists the effects, each a change of settings. `request` parses the option `--effects`. `plan`
records the decisions and derives the settings that follow from them. `review` runs the measurements at the
moments of training when they are cheap; the folder `evidence` has one module for each. `following` passes
the decisions on to the model, its light and the console. `table` formats a plan.

Several measurements fit light and materials to places, which are in the folder `places`. The same fits give
the initial light (`first_light`, with lamps `first_lamps`), with which `start` begins the training, and find
paint at which training is stuck (`places.search`).
"""

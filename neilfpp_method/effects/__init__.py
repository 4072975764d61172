"""Which effects a scene calls for, told by evidence (docs/effects.md).

`catalogue` lists the effects, each a change of settings; `asked` reads what a person wants of them; `plan`
holds what was decided, and makes the settings that follow from it; `looks` measures a model at the moments
when a measurement is cheap, with `visibility` and the other modules of evidence; `table` shows a plan.
"""

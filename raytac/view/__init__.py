"""A scene in the browser: 3-D view, tactile images, sliders; ``raytac view SCENE`` (see docs/viewer.md). Needs ``raytac[view]``."""

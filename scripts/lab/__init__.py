"""How accurate methods are, how fast, and where they fail: what the commands in scripts/ share, no part of the package.

``metrics`` and ``score`` compare a frame with the truth. ``methods`` lists what is compared, ``sets`` the data, and ``rows``
records it. ``speed`` and ``frames`` measure time, ``stability`` methods on the corruptions of ``gallery``, ``evaluate`` methods on
real and drawn sensors, ``coverage`` confidence, ``pose_accuracy`` and ``tracking`` poses. ``figures`` draws all of it.
"""

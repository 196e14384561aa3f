"""How accurate methods are, how fast, and where they fail. Only the command line imports this room.

``metrics`` and ``score`` compare a frame with the truth. ``methods`` lists what is compared, ``sets`` the data, and ``rows``
records it. ``speed``, ``stability`` (on the corruptions of ``gallery``) and ``evaluate`` (on real and drawn sensors) measure
methods; ``coverage`` measures confidence, and ``pose_accuracy`` registration. ``figures`` draws all of it.
"""

"""An echolake from Python.

>>> import echolake
>>> with echolake.connect("grpc://127.0.0.1:8081") as lake:  # doctest: +SKIP
...     table = lake.sql("select surface_id, avg(tnce_total) from tnce group by 1")

`echolake.torch.Measurements` feeds training sets to torch, `echolake.rerun.view` shows runs; both import what they
need only when they are imported themselves.
"""

from echolake.connection import Lake, connect

__all__ = ["Lake", "connect"]
__version__ = "0.1.0"

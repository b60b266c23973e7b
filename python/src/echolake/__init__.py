"""An echolake from Python.

>>> import echolake
>>> with echolake.connect("grpc://127.0.0.1:8081") as lake:  # doctest: +SKIP
...     table = lake.sql("select surface_id, avg(tnce_total) from tnce group by 1")

`echolake.torch.Measurements` feeds training sets to torch, `echolake.rerun.view` shows runs. Each needs its extra:
``echolake[client]`` for queries, ``echolake[torch]``, ``echolake[rerun]``; the command ``echolake`` needs none.
"""

from importlib.metadata import PackageNotFoundError, version

from echolake.connection import Lake, connect

__all__ = ["Lake", "connect"]

try:
    __version__ = version("echolake")
except PackageNotFoundError:  # a checkout on PYTHONPATH
    __version__ = "0+checkout"

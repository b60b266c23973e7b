"""A way back into a served lake: annotations, and predictions of models.

>>> from echolake.contributions import ContributionClient
>>> lake = ContributionClient("http://127.0.0.1:8080")
>>> lake.annotate(run_id, "verdict", "rejected", pair_ids=[7], comment="knocked")  # doctest: +SKIP
>>> lake.predict("cnn", "3", table)  # doctest: +SKIP

What a call stored is on disk when it returns. A call repeats a request whose answer was lost; it is stored once.
"""

from __future__ import annotations

import json
import time
import urllib.error
import urllib.parse
import urllib.request
import uuid
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    import pyarrow as pa

__all__ = ["ContributionClient", "ContributionError"]

_RETRY_SECS = (0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
_RETRIED = (429, 502, 503, 504)
_MOST_BYTES = 1_000_000
"""Of a request; the server takes 1 MiB."""
_MOST_ANNOTATIONS = 1_000


class ContributionError(RuntimeError):
    """A refusal of the server, with its status and its stable code."""

    def __init__(self, status: int, code: str, detail: str) -> None:
        super().__init__(detail)
        self.status = status
        self.code = code


class ContributionClient:
    """Adds to a lake that ``echolake serve`` serves at ``url``; ``token`` needs the scope ``annotate``."""

    def __init__(self, url: str = "http://127.0.0.1:8080", token: str | None = None, author: str | None = None) -> None:
        self._url = url.rstrip("/")
        self._token = token
        self._author = author

    def annotate(
        self,
        run_id: str,
        kind: Literal["label", "verdict", "note"],
        value: str = "",
        *,
        comment: str = "",
        pair_ids: Sequence[int] | None = None,
        microphones: Sequence[int] | None = None,
        speakers: Sequence[int] | None = None,
        annotation_id: str | None = None,
        confirm_rederivation: bool = False,
    ) -> str:
        """Annotates a run, some of its pairs, or a region of its grid; returns the annotation's name.

        A verdict on a run that levels of other surfaces rest on, as those of Flat and Foam, is refused with the code
        ``unconfirmed`` and the number of surfaces and rows that the next ``echolake ingest`` derives again;
        ``confirm_rederivation`` stores it.
        """
        new = {
            "annotation_id": annotation_id,
            "run_id": run_id,
            "kind": kind,
            "value": value,
            "comment": comment,
            "pair_ids": pair_ids,
            "microphones": microphones,
            "speakers": speakers,
        }
        given = {name: value for name, value in new.items() if value is not None}
        return self.annotate_all([given], confirm_rederivation=confirm_rederivation)[0]

    def annotate_all(
        self, annotations: Iterable[Mapping[str, Any]], *, confirm_rederivation: bool = False
    ) -> list[str]:
        """Stores many annotations, the fields of each as in :meth:`annotate`; returns their names.

        They are sent in requests of 1,000, each of which is stored as a whole.
        """
        named = [{"annotation_id": str(uuid.uuid4()), **annotation} for annotation in annotations]
        names: list[str] = []
        for start in range(0, len(named), _MOST_ANNOTATIONS):
            body: dict[str, Any] = {"annotations": named[start : start + _MOST_ANNOTATIONS]}
            if self._author is not None:
                body["author"] = self._author
            if confirm_rederivation:
                body["confirm_rederivation"] = True
            answer = self._post("/api/v1/annotations", json.dumps(body).encode(), "application/json")
            names.extend(answer["annotation_ids"])
        return names

    def predict(self, model: str, version: str, table: pa.Table, project: str | None = None) -> int | None:
        """Stores predictions: ``surface_id``, ``pair_id`` and linear columns of table ``tnce``.

        They are sent by surfaces, in requests of which each is stored as a whole. ``project`` is that of the surfaces'
        runs, ``""`` for runs without one; it is needed if runs of two projects have one of the surfaces. Returns the
        version of the lake that shows them, None for tokens of projects.
        """
        import pyarrow.compute as pc

        named = {"author": self._author or None, "project": project}
        params = {"model": model, "version": version} | {name: text for name, text in named.items() if text is not None}
        path = "/api/v1/predictions?" + urllib.parse.urlencode(params)
        version_of_lake: int | None = None
        waiting = pc.unique(table.column("surface_id")).to_pylist()
        count = len(waiting)
        while waiting:
            body = _arrow_stream(table.filter(pc.field("surface_id").isin(waiting[:count])))
            if len(body) > _MOST_BYTES and count > 1:
                count //= 2
                continue
            version_of_lake = self._post(path, body, "application/vnd.apache.arrow.stream")["lake_version"]
            waiting = waiting[count:]
        return version_of_lake

    def _post(self, path: str, body: bytes, kind: str) -> dict[str, Any]:
        headers = {"Content-Type": kind}
        if self._token is not None:
            headers["Authorization"] = f"Bearer {self._token}"
        request = urllib.request.Request(self._url + path, data=body, headers=headers)
        for wait in (*_RETRY_SECS, None):
            try:
                with urllib.request.urlopen(request, timeout=120) as answer:
                    return dict(json.load(answer))
            except urllib.error.HTTPError as refusal:
                if wait is None or refusal.code not in _RETRIED:
                    raise read_refusal(refusal) from None
            except (urllib.error.URLError, ConnectionError, TimeoutError):
                if wait is None:
                    raise
            time.sleep(wait)
        raise AssertionError("the last try returns or raises")


def read_refusal(error: urllib.error.HTTPError) -> ContributionError:
    """The problem that a server answered; its text is the detail."""
    text = error.read().decode(errors="replace")
    try:
        problem = json.loads(text)
        return ContributionError(error.code, problem["code"], problem["detail"])
    except (ValueError, KeyError, TypeError):
        return ContributionError(error.code, "internal", text or f"the server answered {error.code}")


def _arrow_stream(table: pa.Table) -> bytes:
    import pyarrow as pa

    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, table.schema) as writer:
        writer.write_table(table)
    return bytes(sink.getvalue().to_pybytes())

"""Looks at a replay as a viewer with playback control does: python replay.py ws://HOST:PORT FILE.mcap...

The files are those that are replayed, none of them overlapping; they are read with `mcap`, and what comes over the wire
must be the same. The replay must have been started with --paused. Needs `websockets` and `mcap`.
"""

import asyncio
import collections
import json
import struct
import sys
import time

import websockets
from mcap.reader import make_reader

from checks import Checks

PLAY, PAUSE = 0, 1
PLAYING, PAUSED, ENDED = 0, 1, 3
State = collections.namedtuple("State", "status time speed did_seek request")
Message = collections.namedtuple("Message", "topic time data")


class Viewer:
    """A client; its subscriptions have the numbers of their channels."""

    def __init__(self, socket):
        self.socket = socket

    async def begin(self):
        self.info = json.loads(await self.socket.recv())
        self.topics = {c["id"]: c["topic"] for c in json.loads(await self.socket.recv())["channels"]}

    async def subscribe(self, topics=None):
        wishes = [{"id": id, "channelId": id} for id, t in self.topics.items() if topics is None or t in topics]
        await self.socket.send(json.dumps({"op": "subscribe", "subscriptions": wishes}))

    async def control(self, command, speed, request, seek=None):
        body = struct.pack("<BBfBQI", 3, command, speed, seek is not None, seek or 0, len(request)) + request.encode()
        await self.socket.send(body)

    async def hear(self):
        data = await asyncio.wait_for(self.socket.recv(), 30)
        if data[0] == 1:
            _, subscription, nanos = struct.unpack_from("<BIQ", data)
            return Message(self.topics[subscription], nanos, data[13:])
        if data[0] == 2:
            return struct.unpack_from("<Q", data, 1)[0]
        assert data[0] == 5, data[0]
        status, nanos, speed, did_seek, length = struct.unpack_from("<BQfBI", data, 1)
        assert len(data) == 19 + length
        return State(status, nanos, speed, bool(did_seek), data[19:].decode())

    async def until(self, is_it):
        """What comes up to something: (it, the messages before it)."""
        messages = []
        while not is_it(heard := await self.hear()):
            if isinstance(heard, Message):
                messages.append(heard)
        return heard, messages

    async def answer(self, request):
        return await self.until(lambda h: isinstance(h, State) and h.request == request)


def recorded(paths):
    messages = []
    for path in paths:
        with open(path, "rb") as file:
            for _, channel, message in make_reader(file).iter_messages():
                messages.append(Message(channel.topic, message.log_time, message.data))
    return messages


def nanos(stamp):
    return stamp["sec"] * 10**9 + stamp["nsec"]


async def look(address, files, checks):
    expected = recorded(files)
    start, end = expected[0].time, expected[-1].time
    async with websockets.connect(address, subprotocols=["foxglove.sdk.v1"], max_size=None) as socket:
        viewer = Viewer(socket)
        await viewer.begin()
        checks.same("can be controlled", ["playbackControl", "time"], lambda: viewer.info["capabilities"])
        checks.same("says from when to when", (start, end),
                    lambda: (nanos(viewer.info["dataStartTime"]), nanos(viewer.info["dataEndTime"])))
        await viewer.subscribe()
        at_start = [m for m in expected if m.time == start]
        shown = [await viewer.hear() for _ in at_start]
        checks.same("shows what stands at the start", sorted(at_start), lambda: sorted(shown))
        await viewer.control(PLAY, 1e6, "all")
        began = time.perf_counter()
        state, early = await viewer.answer("all")
        checks.same("plays", PLAYING, lambda: state.status)
        ended, messages = await viewer.until(lambda h: isinstance(h, State) and h.status == ENDED)
        seconds = time.perf_counter() - began
        messages = shown + early + messages
        size = sum(len(m.data) for m in messages)
        print(f"{len(messages)} messages, {size / 1e6:.0f} MB in {seconds:.1f} s: {size / seconds / 1e6:.0f} MB/s")
        checks.holds("all messages, in the order of time", lambda: [m.time for m in messages],
                     lambda times: times == sorted(times))
        checks.holds("the same as in the files", lambda: sorted(messages) == sorted(expected), bool)
        checks.same("ends where the files do", end, lambda: ended.time)
        verdicts = [m.time for m in expected if m.topic == "/measurement"]
        waits = []
        for place in (7, 2, 5, 9, 1):
            there = verdicts[len(verdicts) * place // 10]
            began = time.perf_counter()
            await viewer.control(PAUSE, 1.0, f"to {place}", there)
            state, _ = await viewer.answer(f"to {place}")
            _, messages = await viewer.until(lambda h, there=there: h == there)
            waits.append(time.perf_counter() - began)
            checks.same(f"seeks to {place} tenths", State(PAUSED, there, 1.0, True, f"to {place}"), lambda s=state: s)
            checks.holds("and shows panel, pose and response there", lambda m=messages: {x.topic for x in m},
                         lambda t: {"/panel/scene", "/panel/points", "/microphone/pose", "/ir"} <= t)
            checks.holds("of no later time", lambda m=messages: max(x.time for x in m), lambda t: t <= there)
        print(f"seeks: {min(waits) * 1e3:.0f} to {max(waits) * 1e3:.0f} ms until all topics are shown")
        there = verdicts[len(verdicts) // 2]
        await viewer.control(PLAY, 10.0, "ten", there)
        await viewer.answer("ten")
        began = time.perf_counter()
        heard = await viewer.until(lambda h: isinstance(h, int) and h >= there + 20 * 10**9)
        checks.holds("20 s last 2 s at tenfold speed", lambda: time.perf_counter() - began, lambda s: 1.9 < s < 2.5)
        checks.holds("with the messages of that time", lambda: len(heard[1]), lambda n: n > 0)


def main():
    checks = Checks()
    asyncio.run(look(sys.argv[1], sys.argv[2:], checks))
    return checks.done()


if __name__ == "__main__":
    sys.exit(main())

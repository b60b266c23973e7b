"""Looks on while a run goes on, as a viewer does: python acquire_live.py ws://HOST:PORT [SECONDS]

Needs `websockets`; decodes with `protobuf` from the schemas that the server itself sends.
"""

import asyncio
import base64
import collections
import json
import struct
import sys

import websockets
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from checks import Checks

EXPECTED = ["/tf", "/panel/scene", "/panel/points", "/microphone/pose", "/speaker/pose", "/sweep", "/sweep/audio",
            "/ir", "/environment", "/measurement", "/log", "/robot_description", "/robots/microphone/joint_states",
            "/robots/speaker/joint_states"]


class Text:
    """A string as ROS 2 writes it: four bytes, its length, its letters, a zero."""

    @staticmethod
    def FromString(data):
        return data[8:-1].decode()


def message_class(channel):
    """What decodes a channel's messages; text where they are no protobuf."""
    if channel["encoding"] == "cdr":
        return Text
    files = descriptor_pb2.FileDescriptorSet.FromString(base64.b64decode(channel["schema"]))
    pool = descriptor_pool.DescriptorPool()
    for file in files.file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(channel["schemaName"]))


async def look(address, seconds):
    """What comes: (channels by id, decoded messages by topic, times by topic, announced times)."""
    announced = []
    messages, times = collections.defaultdict(list), collections.defaultdict(list)
    async with websockets.connect(address, subprotocols=["foxglove.sdk.v1"], max_size=None) as socket:
        info = json.loads(await socket.recv())
        channels = {c["id"]: c for c in json.loads(await socket.recv())["channels"]}
        classes = {id: message_class(c) for id, c in channels.items()}
        wishes = [{"id": 100 + id, "channelId": id} for id in channels]
        await socket.send(json.dumps({"op": "subscribe", "subscriptions": wishes}))
        end = asyncio.get_running_loop().time() + seconds
        while (left := end - asyncio.get_running_loop().time()) > 0:
            try:
                data = await asyncio.wait_for(socket.recv(), left)
            except (asyncio.TimeoutError, websockets.ConnectionClosed):
                break
            if data[0] == 2:
                announced.append(struct.unpack_from("<Q", data, 1)[0])
                continue
            op, subscription, time = struct.unpack_from("<BIQ", data)
            assert op == 1, op
            topic = channels[subscription - 100]["topic"]
            messages[topic].append(classes[subscription - 100].FromString(data[13:]))
            times[topic].append(time)
    return info, channels, messages, times, announced


def main():
    address = sys.argv[1]
    seconds = float(sys.argv[2]) if len(sys.argv) > 2 else 5.0
    info, channels, messages, times, announced = asyncio.run(look(address, seconds))
    checks = Checks()
    checks.same("says who it is", "serverInfo", lambda: info["op"])
    checks.same("offers every topic", sorted(EXPECTED), lambda: sorted(c["topic"] for c in channels.values()))
    for topic in EXPECTED:
        checks.holds(f"{topic}: messages come and decode", lambda t=topic: len(messages[t]),
                     lambda n, t=topic: n > 0 or t == "/log")
    checks.holds("the panel is a GLB", lambda: messages["/panel/scene"][0].entities[0].models[0].data[:4],
                 lambda b: b == b"glTF")
    checks.holds("the arms are a URDF", lambda: messages["/robot_description"][0][:200], lambda t: "<robot" in t)
    checks.holds("every sweep is as long as it says",
                 lambda: {len(s.microphone) / s.sample_count for s in messages["/sweep"]}, lambda w: w == {3.0})
    checks.same("announces the simulated run's time", ["time"], lambda: info["capabilities"])
    checks.holds("announced times go on", lambda: announced, lambda t: t and t == sorted(set(t)))
    checks.same("the last is the last message's", max(t for ts in times.values() for t in ts), lambda: announced[-1])
    checks.holds("time goes on", lambda: times["/measurement"], lambda t: t == sorted(set(t)))
    checks.holds("verdicts have a ratio", lambda: min(m.snr_db for m in messages["/measurement"]), lambda x: x > 0)
    return checks.done()


if __name__ == "__main__":
    sys.exit(main())

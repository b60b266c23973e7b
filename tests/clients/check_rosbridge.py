"""Talks to the fake rosbridge with roslibpy, so that the fake is one to others too: `check_rosbridge.py FAKE`.

FAKE is the program: `cargo build --profile quick -p echolake-acquisition --example fake-rosbridge`. Needs the PyPI package
roslibpy. Exits with 1 and says what is wrong.
"""
import subprocess
import sys
import threading
import time
from urllib.parse import urlparse

import roslibpy

TARGET = [0.3, -0.1, 1.8, 0.05, 0.9, -0.4]


def check(ros):
    states, news = {}, threading.Event()

    def heard(message):
        states.update(zip(message["name"], message["position"]))
        news.set()

    joints = roslibpy.Topic(ros, "/speaker/joint_states", "sensor_msgs/JointState")
    joints.subscribe(heard)
    assert news.wait(5), "no joint states"
    assert sorted(states) == [f"joint_{i}" for i in range(1, 7)], f"joints are {sorted(states)}"

    def call(name):
        return roslibpy.Service(ros, name, "std_srvs/Trigger").call(roslibpy.ServiceRequest(), timeout=5)

    command = roslibpy.Topic(ros, "/speaker/joint_path_command", "trajectory_msgs/JointTrajectory")
    command.advertise()
    point = {"positions": TARGET, "time_from_start": {"secs": 0, "nsecs": 300_000_000}}
    message = roslibpy.Message({"joint_names": sorted(states), "points": [point]})

    before = dict(states)
    command.publish(message)
    time.sleep(0.6)
    assert states == before, "an arm moved without power"
    assert call("/speaker/robot_enable")["success"], "motors do not come on"
    command.publish(message)
    time.sleep(0.8)
    off = max(abs(states[f"joint_{i + 1}"] - wanted) for i, wanted in enumerate(TARGET))
    assert off < 1e-9, f"an arm is {off} rad off its target"
    assert call("/speaker/robot_disable")["success"], "motors do not go off"
    assert not call("/speaker/robot_dance")["success"], "a service that is not there answers"
    joints.unsubscribe()


def main(program):
    fake = subprocess.Popen([program, "127.0.0.1:0"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        url = urlparse(fake.stdout.readline().strip())
        ros = roslibpy.Ros(host=url.hostname, port=url.port)
        ros.run(timeout=10)
        try:
            check(ros)
        finally:
            ros.terminate()
    finally:
        fake.stdin.close()
        assert fake.wait(timeout=10) == 0, "the fake did not end well"
    print(f"roslibpy {roslibpy.__version__}: joint states, motors and a trajectory, as a rosbridge does them")


if __name__ == "__main__":
    try:
        main(sys.argv[1])
    except AssertionError as error:
        sys.exit(str(error))

"""Checks a dashboard of docs/grafana: `check_dashboard.py http://127.0.0.1:9108/metrics http://127.0.0.1:8428 [SECONDS [run|server]]`.

The first address is that of `echolake acquire --metrics` or of a server, the second that of VictoriaMetrics or Prometheus
(2.x), which asks it at least every five seconds. Every query of the dashboard is asked there as Grafana would, for all
surfaces or servers, and has to answer with numbers within SECONDS (60). Every metric of the dashboard has to be one of the
first address. A server wants a query now and then meanwhile, else nothing has a mean. Needs nothing beside Python. Prints a line a check, exits with 1 where one fails.
"""
import json
import pathlib
import re
import sys
import time
import urllib.error
import urllib.parse
import urllib.request

from checks import Checks

DASHBOARDS = pathlib.Path(__file__).parents[2] / "docs" / "grafana"
METRIC = re.compile(r"\becholake_[a-z_]+")
LABEL_VALUES = re.compile(r"label_values\((\w+), (\w+)\)")
# A ratio to a rate that is not there yet, or not above nothing, has no value; so has a run that measured nothing yet.
PATIENCE_SECS = 60


def asked(url):
    with urllib.request.urlopen(url, timeout=10) as answer:
        return answer.read().decode()


def numbers(store, query, until):
    """The values that a query has, asked again until there are some."""
    url = f"{store}/api/v1/query?{urllib.parse.urlencode({'query': query})}"
    while True:
        try:
            found = json.loads(asked(url))
        except urllib.error.HTTPError as error:
            return f"{error.code}: {error.read().decode()[:300]}"
        values = [row["value"][1] for row in found["data"]["result"]]
        if values or time.monotonic() > until:
            return values
        time.sleep(1)


def main(metrics, store, seconds=PATIENCE_SECS, name="run"):
    checks = Checks()
    dashboard = json.loads((DASHBOARDS / f"{name}.json").read_text())
    targets = [(panel["title"], target["expr"]) for panel in dashboard["panels"] for target in panel["targets"]]
    offered = {re.split("[{ ]", line)[0] for line in asked(metrics).splitlines() if not line.startswith("#")}
    wanted = {name for _, expression in targets for name in METRIC.findall(expression)}
    checks.same("metrics that are not there", set(), lambda: wanted - offered)
    until = time.monotonic() + float(seconds)
    for variable in dashboard["templating"]["list"]:
        if variable["type"] == "query":
            metric, label = LABEL_VALUES.fullmatch(variable["query"]).groups()
            address = f"{store}/api/v1/label/{label}/values?{urllib.parse.urlencode({'match[]': metric})}"
            checks.holds(f"values of ${variable['name']}", lambda: json.loads(asked(address))["data"], bool)
    for title, expression in targets:
        query = expression.replace("$surface", ".*").replace("$instance", ".*")
        checks.holds(f"{title}: {query}", lambda: numbers(store, query, until), lambda found: isinstance(found, list) and found)
    return checks.done()


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))

"""Checks users of an identity provider: `oidc_clients.py ECHOLAKE LAKE [--port 9300]`.

It starts oidc-provider-mock as the provider and serves the lake with it, fetches tokens by the authorization code flow, and asks
over HTTP, Postgres' protocol and Flight SQL. Tokens for another audience, changed ones and those of users without a group must be
refused, and known keys must serve while the provider is away. A provider that comes back with other keys has its new tokens taken.
Needs the PyPI packages oidc-provider-mock, httpx, psycopg[binary], adbc-driver-flightsql and pyarrow.
"""
import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from urllib.parse import parse_qs, urlparse

import httpx

from checks import Checks

AUDIENCE = "lake"
GROUPS = '[[group]]\nname = "lab"\nscopes = ["sql"]\n'
USERS = {"ann": ["lab"], "bob": ["elsewhere"]}


class Provider:
    """An identity provider; each has keys of its own."""

    def __init__(self, port):
        self.issuer = f"http://localhost:{port}"
        users = [part for name, groups in USERS.items() for part in ("--user-claims", json.dumps({"sub": name, "groups": groups}))]
        program = os.path.join(os.path.dirname(sys.executable), "oidc-provider-mock")
        self.process = subprocess.Popen([program, "-p", str(port), *users], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        wait_for(f"{self.issuer}/.well-known/openid-configuration")

    def token(self, user, audience=AUDIENCE):
        """A user's token, as an application gets it."""
        back = "http://localhost:1/back"
        asked = {"client_id": audience, "redirect_uri": back, "response_type": "code", "scope": "openid profile", "state": "x"}
        shown = httpx.post(f"{self.issuer}/oauth2/authorize", params=asked, data={"sub": user})
        code = parse_qs(urlparse(shown.headers["location"]).query)["code"][0]
        given = {"grant_type": "authorization_code", "code": code, "redirect_uri": back}
        return httpx.post(f"{self.issuer}/oauth2/token", data=given, auth=(audience, "secret")).json()["id_token"]

    def stop(self):
        """Ends it."""
        self.process.send_signal(signal.SIGTERM)
        self.process.wait(20)


def wait_for(url):
    """Waits until it is answered."""
    for _ in range(200):
        try:
            return httpx.get(url)
        except httpx.TransportError:
            time.sleep(0.1)
    sys.exit(f"{url} is not answered within 20 s")


def over_http(port, token):
    """The status of a query."""
    headers = {"authorization": f"Bearer {token}", "content-type": "text/plain"}
    return httpx.post(f"http://localhost:{port}/api/v1/sql", content="select 7", headers=headers).status_code


def over_postgres(port, token):
    """Who asks, as the server calls it."""
    import psycopg
    with psycopg.connect(host="localhost", port=port, user="token", password=token, dbname="datafusion") as lake:
        return lake.execute("select distinct client from system.queries").fetchone()[0]


def over_flight_sql(port, token):
    """The same."""
    import adbc_driver_flightsql.dbapi as driver
    login = {"username": "anybody", "password": token}
    with driver.connect(f"grpc://localhost:{port}", db_kwargs=login, autocommit=True) as lake, lake.cursor() as cursor:
        cursor.execute("select distinct client from system.queries")
        return cursor.fetchone()[0]


def check(checks, provider, port):
    """All of it."""
    token = provider.token("ann")
    checks.same("HTTP", 200, lambda: over_http(port, token))
    checks.same("Postgres", "oidc:ann", lambda: over_postgres(port + 2, token))
    checks.same("Flight SQL", "oidc:ann", lambda: over_flight_sql(port + 1, token))
    header, payload, signature = token.split(".")
    changed = "B" if signature[10] == "A" else "A"
    wrong = {
        "another audience": provider.token("ann", "other"),
        "a changed signature": f"{header}.{payload}.{signature[:10]}{changed}{signature[11:]}",
        "no signature": f"{header}.{payload}.",
        "no group": provider.token("bob"),
    }
    for name, refused in wrong.items():
        checks.same(name, 401, lambda: over_http(port, refused))
    fresh = provider.token("ann")
    provider.stop()
    checks.same("the provider is away", 200, lambda: over_http(port, fresh))


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("program")
    parser.add_argument("lake")
    parser.add_argument("--port", type=int, default=9300, help="the first of four ports")
    given = parser.parse_args()
    checks = Checks()
    with tempfile.TemporaryDirectory() as folder:
        tokens = os.path.join(folder, "tokens.toml")
        with open(tokens, "w", encoding="utf-8") as file:
            file.write(GROUPS)
        provider = Provider(given.port + 3)
        listen = [part for at, name in enumerate(["listen", "flight-sql", "postgres"]) for part in (f"--{name}", f"127.0.0.1:{given.port + at}")]
        oidc = ["--tokens", tokens, "--oidc", provider.issuer, "--oidc-audience", AUDIENCE, "--temp", folder]
        server = subprocess.Popen([given.program, "--lake", given.lake, "serve", *listen, *oidc], stderr=subprocess.DEVNULL)
        try:
            wait_for(f"http://localhost:{given.port}/health")
            check(checks, provider, given.port)
            provider = Provider(given.port + 3)
            # The server looks at it once in ten seconds at most.
            time.sleep(10)
            checks.same("other keys", 200, lambda: over_http(given.port, provider.token("ann")))
        finally:
            server.send_signal(signal.SIGINT)
            server.wait(60)
            provider.stop()
    return checks.done()


if __name__ == "__main__":
    sys.exit(main())

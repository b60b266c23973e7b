//! `echolake serve` and `echolake token`: the lake over HTTP, Flight SQL and Postgres, for those who may.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::path::PathBuf;
use std::str::FromStr;

use echolake_lake::Lake;
use echolake_query::Limits;
use echolake_server::tokens::{self, Tokens};
use echolake_server::{CataloguePages, Error, Server, Settings};

use crate::Done;
use crate::signals::StopRequest;

/// Memory for queries, and how many of them may be heavy, if nobody says otherwise.
const MEMORY_MIB: u32 = 4096;
const HEAVY: u32 = 2;

#[derive(Debug, clap::Args)]
pub(crate) struct ServeArgs {
    /// Address for HTTP, `off` for none; port 0 for any that is free, and so below.
    #[arg(long, value_name = "ADDRESS", default_value = "127.0.0.1:8080")]
    listen: Listen,
    /// Address for Arrow Flight SQL.
    #[arg(long, value_name = "ADDRESS", default_value = "127.0.0.1:8081")]
    flight_sql: Listen,
    /// Address for Postgres' protocol.
    #[arg(long, value_name = "ADDRESS", default_value = "127.0.0.1:5433")]
    postgres: Listen,
    /// File of tokens, without which only this machine may ask; `echolake token` makes its lines.
    #[arg(long, value_name = "FILE")]
    tokens: Option<PathBuf>,
    /// Memory that the queries may hold, all together.
    #[arg(long, value_name = "MIB", default_value_t = MEMORY_MIB, value_parser = clap::value_parser!(u32).range(64..))]
    memory: u32,
    /// Queries at once that read much; more of them wait, and each may hold its part of the memory.
    #[arg(long, value_name = "N", default_value_t = HEAVY, value_parser = clap::value_parser!(u32).range(1..=64))]
    heavy: u32,
}

/// Where to listen.
#[derive(Debug, Clone, Copy)]
enum Listen {
    Off,
    On(SocketAddr),
}

impl FromStr for Listen {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "off" => Ok(Self::Off),
            _ => text.parse().map(Self::On).map_err(|_| "not as 127.0.0.1:8080, [::1]:8080 or off".to_owned()),
        }
    }
}

impl Listen {
    fn address(self) -> Option<SocketAddr> {
        match self {
            Self::Off => None,
            Self::On(address) => Some(address),
        }
    }
}

/// Where HTTP is served if nobody says otherwise.
const HTTP: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 8080);

pub(crate) async fn run(args: &ServeArgs, lake_url: &str) -> anyhow::Result<Done> {
    let stop = StopRequest::listen("stopping: answers may go on for five seconds; Ctrl-C again stops at once")?;
    let lake = Lake::open(lake_url).await?;
    let settings = Settings {
        http: args.listen.address(),
        flight_sql: args.flight_sql.address(),
        postgres: args.postgres.address(),
        tokens: args.tokens.as_deref().map(Tokens::read).transpose()?,
        limits: limits(args.memory, args.heavy),
    };
    let server = Server::bind(&lake, settings).await?;
    anyhow::ensure!(!server.addresses().is_empty(), "nothing to listen on; hint: all three are off");
    eprintln!("lake {}", lake.location());
    answer(server, &stop).await
}

/// Serves the catalogue alone, where others look for it or, if somebody else is there, on any port that is free.
pub(crate) async fn catalogue(lake: &Lake, stop: &StopRequest) -> anyhow::Result<Done> {
    let settings = |http| Settings {
        http: Some(http),
        flight_sql: None,
        postgres: None,
        tokens: None,
        limits: limits(MEMORY_MIB, HEAVY),
    };
    let server = match Server::bind(lake, settings(HTTP)).await {
        Err(Error::Bind { .. }) => Server::bind(lake, settings(SocketAddr::new(HTTP.ip(), 0))).await?,
        bound => bound?,
    };
    eprintln!("the catalogue, until Ctrl-C:");
    answer(server, stop).await
}

fn limits(memory_mib: u32, heavy: u32) -> Limits {
    Limits { memory: Some((memory_mib as usize) << 20), heavy: heavy as usize }
}

async fn answer(server: Server, stop: &StopRequest) -> anyhow::Result<Done> {
    if let Some(problem) = CataloguePages::THIS_BUILD.problem() {
        eprintln!("note: this program was {problem}");
    }
    for address in server.addresses() {
        eprintln!("  {address}");
    }
    server.run(stop.wait()).await?;
    Ok(Done::Whole)
}

/// Prints a new token to stderr, once, and its lines for the file of tokens to stdout.
pub(crate) fn token(name: &str) -> anyhow::Result<Done> {
    let fresh = tokens::fresh(name)?;
    eprintln!("{}\nthis token is kept nowhere: only its hash is, in the lines for the file of --tokens", fresh.token);
    super::print(fresh.lines.trim_end())?;
    Ok(Done::Whole)
}

//! Ends queries of several kinds in each way that there is, and measures how soon the server's processes are idle.
#![allow(clippy::print_stdout, reason = "figures are what it is for")]

use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Result, ensure};

use super::observed_server::{ClientGroup, ObservedServer, PostgresClient, QueryClient, QueryProtocol};
use super::percentile::{millis, percentile};

/// From the end of a query until the server is idle, p99.
const IDLE_GOAL: Duration = Duration::from_millis(500);
/// A server that works for longer is replaced.
const IDLE_LIMIT: Duration = Duration::from_secs(15);
/// How long a query runs before it is ended: longer than it takes to be parsed.
const RUN_TIME: Duration = Duration::from_millis(1000);

/// Whose queries run into no limit, and whose end after a second.
const CLIENTS: [ClientGroup; 2] = [
    ClientGroup { name: "light", count: 16, limits: "seconds = 60\nmemory_mb = 1000\nconcurrent = 4\n" },
    ClientGroup { name: "limited", count: 16, limits: "seconds = 1\nmemory_mb = 1000\nconcurrent = 4\n" },
];

/// A statement that works for as long as it is let.
#[derive(Debug, Clone, Copy)]
pub(crate) struct EndlessQuery {
    name: &'static str,
    text: fn() -> String,
}

/// The statements, each held up in another place.
pub(crate) const ENDLESS_QUERIES: [EndlessQuery; 7] = [
    EndlessQuery {
        name: "long scan",
        text: || "select count(*) from generate_series(1, 1000000000000) t(v) where v % 7 = 9".into(),
    },
    EndlessQuery {
        name: "cross join without rows",
        text: || {
            "select count(*) from generate_series(1, 1000000) a cross join generate_series(1, 1000000) b where a.value \
             + b.value = 7"
                .into()
        },
    },
    EndlessQuery {
        name: "planning",
        text: || {
            let call = |n| format!("levenshtein(repeat('a',300000), repeat('b',300000)) as c{n}");
            format!("select {}", (0..10_000).map(call).collect::<Vec<_>>().join(","))
        },
    },
    EndlessQuery {
        name: "one call",
        text: || "select levenshtein(repeat(run_id, 40000), repeat(surface_id, 200000)) from runs".into(),
    },
    EndlessQuery {
        name: "one call that allocates",
        text: || "select cardinality(array_resize([''], 1000, repeat('x',100000000))) x".into(),
    },
    EndlessQuery {
        name: "sort",
        text: || {
            "select v from generate_series(1, 300000000) t(v) order by v % 1000, -v limit 3 offset 200000000".into()
        },
    },
    EndlessQuery {
        name: "regular expression",
        text: || {
            "select regexp_count(repeat('a', 50000000 + v), '(a{1,50}){1,50}b') from generate_series(1,9) t(v)".into()
        },
    },
];

/// A way to end a query.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum QueryEnd {
    CancelRequest,
    StatementTimeout,
    TokenSeconds(QueryProtocol),
    ClosedConnection(QueryProtocol),
}

/// All ways.
pub(crate) const QUERY_ENDS: [QueryEnd; 8] = [
    QueryEnd::CancelRequest,
    QueryEnd::StatementTimeout,
    QueryEnd::TokenSeconds(QueryProtocol::Http),
    QueryEnd::TokenSeconds(QueryProtocol::PostgresSimple),
    QueryEnd::TokenSeconds(QueryProtocol::FlightSql),
    QueryEnd::ClosedConnection(QueryProtocol::Http),
    QueryEnd::ClosedConnection(QueryProtocol::PostgresSimple),
    QueryEnd::ClosedConnection(QueryProtocol::FlightSql),
];

#[derive(Debug, clap::Args)]
pub(crate) struct CancelArgs {
    /// How often each query is ended in each way.
    #[arg(default_value_t = 10)]
    rounds: usize,
    /// Only rows with this text in `QUERY END`.
    #[arg(long, value_name = "SUBSTRING")]
    only: Option<String>,
}

/// A query and an end of it.
#[derive(Debug)]
pub(crate) struct CancelRow {
    pub(crate) title: String,
    /// From the end until the server was idle; the limit if it was not.
    pub(crate) times: Vec<Duration>,
    /// How often the server worked on at the limit, or died.
    pub(crate) failures: usize,
}

impl CancelRow {
    pub(crate) fn is_goal_reached(&self) -> bool {
        self.failures == 0 && percentile(&self.times, 0.99) <= IDLE_GOAL
    }
}

impl QueryEnd {
    fn name(self) -> String {
        match self {
            Self::CancelRequest => "CancelRequest".to_owned(),
            Self::StatementTimeout => "statement_timeout".to_owned(),
            Self::TokenSeconds(protocol) => format!("token seconds, {}", protocol.name()),
            Self::ClosedConnection(protocol) => format!("closed, {}", protocol.name()),
        }
    }
}

pub(crate) fn run(args: &CancelArgs) -> Result<()> {
    let binary = super::echolake_path()?;
    let rows = run_cancels(&binary, &QUERY_ENDS, args.rounds, args.only.as_deref(), &mut print_row)?;
    let missed = rows.iter().filter(|row| !row.is_goal_reached()).count();
    ensure!(missed == 0, "{missed} of {} rows miss the goal: idle within {IDLE_GOAL:?}, p99", rows.len());
    Ok(())
}

/// Ends each query in each of these ways, so many times; `progress` sees each row.
///
/// # Errors
/// The lake cannot be made.
pub(crate) fn run_cancels(
    binary: &Path,
    ends: &[QueryEnd],
    rounds: usize,
    only: Option<&str>,
    progress: &mut dyn FnMut(&CancelRow),
) -> Result<Vec<CancelRow>> {
    let mut server = ObservedServer::start(binary, &CLIENTS)?;
    let mut rows = Vec::new();
    for query in ENDLESS_QUERIES {
        for end in ends {
            let title = format!("{} {}", query.name, end.name());
            if only.is_none_or(|part| title.contains(part)) {
                let row = measure_row(&mut server, title, query, *end, rounds);
                progress(&row);
                rows.push(row);
            }
        }
    }
    Ok(rows)
}

fn print_row(row: &CancelRow) {
    let at = |share| millis(percentile(&row.times, share));
    let failures = if row.failures > 0 { format!(", {} not idle or dead", row.failures) } else { String::new() };
    println!("{:52} p50 {:6.0} ms, p99 {:6.0} ms{failures}", row.title, at(0.5), at(0.99));
}

fn measure_row(
    server: &mut ObservedServer,
    title: String,
    query: EndlessQuery,
    end: QueryEnd,
    rounds: usize,
) -> CancelRow {
    let mut row = CancelRow { title, times: Vec::new(), failures: 0 };
    for round in 0..rounds {
        let group = if matches!(end, QueryEnd::TokenSeconds(_)) { "limited" } else { "light" };
        let client = server.client(group, round);
        let idle = end_query(server, &client, end, &(query.text)());
        row.times.push(idle.unwrap_or(IDLE_LIMIT));
        if idle.is_none() || !server.is_alive() {
            row.failures += 1;
            server.restart();
        }
    }
    row
}

// None if the server works on at the limit. The connections are closed in any case before this returns.
fn end_query(server: &ObservedServer, client: &QueryClient, end: QueryEnd, sql: &str) -> Option<Duration> {
    let idle = match end {
        QueryEnd::CancelRequest | QueryEnd::StatementTimeout => end_in_session(server, client, end, sql),
        QueryEnd::TokenSeconds(protocol) => end_outside(server, client, protocol, sql, &|| ()),
        QueryEnd::ClosedConnection(protocol) => {
            end_outside(server, client, protocol, sql, &|| client.connections.close_all())
        }
    };
    client.connections.close_all();
    idle
}

fn end_in_session(server: &ObservedServer, client: &QueryClient, end: QueryEnd, sql: &str) -> Option<Duration> {
    let mut session = PostgresClient::log_in(client).ok()?.ok()?;
    if end == QueryEnd::StatementTimeout {
        session.begin_query(&format!("set statement_timeout = '{}ms'", RUN_TIME.as_millis())).ok()?;
        session.read_answer();
    }
    session.begin_query(sql).ok()?;
    std::thread::sleep(RUN_TIME);
    if end == QueryEnd::CancelRequest {
        session.send_cancel(client).ok()?;
    }
    server.process_tree().time_until_idle(Instant::now(), IDLE_LIMIT)
}

// What comes of the query is not looked at.
fn end_outside(
    server: &ObservedServer,
    client: &QueryClient,
    protocol: QueryProtocol,
    sql: &str,
    end: &dyn Fn(),
) -> Option<Duration> {
    std::thread::scope(|scope| {
        scope.spawn(|| client.query(protocol, sql));
        std::thread::sleep(RUN_TIME);
        end();
        let idle = server.process_tree().time_until_idle(Instant::now(), IDLE_LIMIT);
        client.connections.close_all();
        idle
    })
}

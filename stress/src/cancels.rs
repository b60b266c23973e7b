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
/// Time for which a query runs before it is ended: longer than parsing takes.
const RUN_TIME: Duration = Duration::from_millis(1000);
/// The last part of it, in which the server is observed: it must work then, or the query has ended by itself.
const LOOK_TIME: Duration = Duration::from_millis(200);
/// Processor time of a server that works, in that part; a busy machine leaves it a tenth.
const WORK_TIME: Duration = Duration::from_millis(20);

/// Clients whose queries run into no limit, and clients whose queries end after a second.
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
        text: || {
            "select sum(strpos(repeat('a',100000000) || v, repeat('a',50000000) || 'b')) from generate_series(1,9) t(v)"
                .into()
        },
    },
    EndlessQuery {
        name: "one call that allocates",
        text: || "select length(translate(repeat('a',250000000), 'a', 'bb')) x".into(),
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
            "select count(*) from generate_series(1,10000000) t(v) where regexp_like('aaaa', '(' || v || \
             '|a{1,200}){1,9}')"
                .into()
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
    /// Times that each query is ended in each way.
    #[arg(default_value_t = 10)]
    rounds: usize,
    /// Only rows with this text in `QUERY END`.
    #[arg(long, value_name = "SUBSTRING")]
    only: Option<String>,
}

/// Outcome of ending a query.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum IdleOutcome {
    /// It had ended by itself, or never begun: nothing is measured.
    EndedBefore,
    /// The server was idle after this time.
    IdleAfter(Duration),
    /// The server worked on at the limit.
    NeverIdle,
}

/// A query and an end of it.
#[derive(Debug)]
pub(crate) struct CancelRow {
    pub title: String,
    /// From the end until the server was idle.
    times: Vec<Duration>,
    /// Number of times that the query was not running when it should have been ended.
    ended_before: usize,
    /// Number of times that the server still worked at the limit, or died.
    pub failures: usize,
}

impl CancelRow {
    // A row without times shows nothing.
    fn is_goal_reached(&self) -> bool {
        self.failures == 0 && !self.times.is_empty() && percentile(&self.times, 0.99) <= IDLE_GOAL
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

pub(crate) fn run_cancel_campaign(args: &CancelArgs) -> Result<()> {
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
    println!(
        "{:56} {:3} times: p50 {:6.0} ms, p99 {:6.0} ms; {} not idle or dead, {} ended before",
        row.title,
        row.times.len(),
        at(0.5),
        at(0.99),
        row.failures,
        row.ended_before,
    );
}

fn measure_row(
    server: &mut ObservedServer,
    title: String,
    query: EndlessQuery,
    end: QueryEnd,
    rounds: usize,
) -> CancelRow {
    let mut row = CancelRow { title, times: Vec::new(), ended_before: 0, failures: 0 };
    for round in 0..rounds {
        let group = if matches!(end, QueryEnd::TokenSeconds(_)) { "limited" } else { "light" };
        let client = server.client(group, round);
        let outcome = end_query(server, &client, end, &(query.text)());
        match outcome {
            IdleOutcome::EndedBefore => row.ended_before += 1,
            IdleOutcome::IdleAfter(time) => row.times.push(time),
            IdleOutcome::NeverIdle => {}
        }
        if outcome == IdleOutcome::NeverIdle || !server.is_alive() {
            row.failures += 1;
            server.restart();
        }
    }
    row
}

// The connections are closed in any case before this returns, and the next query meets an idle server.
fn end_query(server: &ObservedServer, client: &QueryClient, end: QueryEnd, sql: &str) -> IdleOutcome {
    let outcome = match end {
        QueryEnd::CancelRequest | QueryEnd::StatementTimeout => {
            end_in_session(server, client, end, sql).unwrap_or(IdleOutcome::EndedBefore)
        }
        QueryEnd::TokenSeconds(protocol) => end_outside(server, client, protocol, sql, &|| ()),
        QueryEnd::ClosedConnection(protocol) => {
            end_outside(server, client, protocol, sql, &|| client.connections.close_all())
        }
    };
    client.connections.close_all();
    match server.wait_until_idle(IDLE_LIMIT) {
        true => outcome,
        false => IdleOutcome::NeverIdle,
    }
}

// None if the server does not begin the session.
fn end_in_session(server: &ObservedServer, client: &QueryClient, end: QueryEnd, sql: &str) -> Option<IdleOutcome> {
    let mut session = PostgresClient::log_in(client).ok()?.ok()?;
    if end == QueryEnd::StatementTimeout {
        session.begin_query(&format!("set statement_timeout = '{}ms'", RUN_TIME.as_millis())).ok()?;
        session.read_answer();
    }
    session.begin_query(sql).ok()?;
    let is_running = is_working_after_run(server);
    if end == QueryEnd::CancelRequest {
        session.send_cancel(client).ok()?;
    }
    Some(idle_outcome(server, is_running))
}

// Lets a query run; a server that has stopped working by then has ended it.
fn is_working_after_run(server: &ObservedServer) -> bool {
    std::thread::sleep(RUN_TIME - LOOK_TIME);
    server.process_tree().processor_time_over(LOOK_TIME) >= WORK_TIME
}

fn idle_outcome(server: &ObservedServer, is_running: bool) -> IdleOutcome {
    match server.process_tree().time_until_idle(Instant::now(), IDLE_LIMIT) {
        _ if !is_running => IdleOutcome::EndedBefore,
        Some(time) => IdleOutcome::IdleAfter(time),
        None => IdleOutcome::NeverIdle,
    }
}

// The query's own outcome is ignored.
fn end_outside(
    server: &ObservedServer,
    client: &QueryClient,
    protocol: QueryProtocol,
    sql: &str,
    end: &dyn Fn(),
) -> IdleOutcome {
    std::thread::scope(|scope| {
        scope.spawn(|| client.query(protocol, sql));
        let is_running = is_working_after_run(server);
        end();
        let outcome = idle_outcome(server, is_running);
        client.connections.close_all();
        outcome
    })
}

//! Ways in which a client could see runs of other projects: statements, and addresses of HTTP.

/// The names of what a client of another project must not see.
pub(super) struct HiddenRun {
    pub surface: String,
    pub run: String,
}

/// A statement that shows hidden runs to whoever may see them.
pub(super) struct ProjectAttempt {
    pub sql: String,
    /// Its answer depends on rows alone, not on the files and versions in which they are.
    pub is_exact: bool,
}

/// Tables and views that have rows of runs.
const TABLES: [&str; 14] = [
    "surfaces",
    "runs",
    "measurements",
    "nce",
    "tnce",
    "tnce_d4",
    "heightmaps",
    "environment",
    "events",
    "surface_stats",
    "ir",
    "tnce_db",
    "augmented",
    "catalogue",
];

/// All statements; `version` is a version of the lake that has the hidden run.
pub(super) fn statements(hidden: &HiddenRun, version: u64) -> Vec<ProjectAttempt> {
    let exact = TABLES.iter().flat_map(|table| of_table(table, hidden)).chain(across_tables(hidden));
    let exact = exact.map(|sql| ProjectAttempt { sql, is_exact: true });
    // The plan of `catalogue` with all of its steps is longer than what an agent is answered.
    let planned = TABLES.iter().filter(|table| **table != "catalogue");
    let plans = planned.flat_map(|table| plans(table, hidden)).chain(system(hidden));
    let past = TABLES.iter().flat_map(|table| past(table, version));
    let others = plans.chain(past).chain(files(hidden)).map(|sql| ProjectAttempt { sql, is_exact: false });
    exact.chain(others).collect()
}

fn of_table(table: &str, HiddenRun { surface, .. }: &HiddenRun) -> Vec<String> {
    let last = surface.chars().next_back().unwrap_or_default();
    let column = if table == "catalogue" { "surface_id" } else { "run_id" };
    vec![
        format!("select count(*) as n from {table}"),
        format!("select count(*) as n from {table} where surface_id = '{surface}'"),
        format!(
            "select point_id from points where exists (select 1 from {table} where surface_id = '{surface}') order by 1"
        ),
        format!("select distinct surface_id from {table} order by 1"),
        format!("select surface_id, count(*) as n from {table} group by 1 order by 1"),
        format!("select max(surface_id) as most, min({column}) as least from {table}"),
        format!("select max({column}) as most from {table}"),
        format!("select {column} from {table} order by surface_id desc, {column} desc limit 1"),
        format!("select count(distinct {column}) as n from {table}"),
        format!("select approx_distinct(surface_id) as n from {table}"),
        format!("select string_agg(distinct surface_id, ',' order by surface_id) as all_names from {table}"),
        format!("select sum(length({column})) as n from {table}"),
        format!("select surface_id from {table} where surface_id like '%{last}' group by 1 order by 1"),
        format!("select surface_id from {table} where surface_id > 'w' group by 1 order by 1"),
        format!("(select surface_id from {table}) except (select 'flat') order by 1"),
        format!("select count(*) as n from {table} where surface_id not in ('flat', 'foam', 'brick_ours')"),
        format!("with all_rows as (select * from {table}) select count(surface_id) as n from all_rows"),
        format!("select first_value({column}) over (order by {column} desc) as first from {table} order by 1 limit 1"),
    ]
}

fn across_tables(HiddenRun { surface, run }: &HiddenRun) -> Vec<String> {
    let mut all: Vec<String> = TABLES[1..10]
        .iter()
        .flat_map(|table| {
            [
                format!(
                    "select s.surface_id, count(*) as n from surfaces s join {table} t using (surface_id) group by \
                    1 order by 1"
                ),
                format!(
                    "select count(t.surface_id) as n from pairs p left join {table} t on t.surface_id = \
                    '{surface}'"
                ),
                format!("select (select max(surface_id) from {table}) as most"),
            ]
        })
        .collect();
    all.extend([
        format!("select parameters from surfaces where surface_id = '{surface}'"),
        format!("select file, file_bytes, file_sha256 from runs where run_id = '{run}'"),
        "select project, count(*) as n from runs group by 1 order by 1".to_owned(),
        "select project, count(*) as n from surfaces group by 1 order by 1".to_owned(),
        "select sum(measurements) as n, sum(file_bytes) as bytes from runs".to_owned(),
        "select avg(ir[1]) as mean from measurements".to_owned(),
        "select sum(tnce_total) as total from tnce".to_owned(),
        "select avg(heights_mm[1]) as mean from heightmaps".to_owned(),
        "select max(log_time_ns) as latest from events".to_owned(),
        "select max(log_time_ns) as latest from environment".to_owned(),
        "select max(ended_ns) as latest from runs".to_owned(),
        "select avg(mean) as mean from (select avg(p90_mean_db) as mean from surface_stats group by run_id)".to_owned(),
        "select approx_median(direct_mm) as median, count(*) as n from ir".to_owned(),
    ]);
    all
}

fn plans(table: &str, HiddenRun { surface, .. }: &HiddenRun) -> Vec<String> {
    vec![
        format!("explain select surface_id from {table}"),
        format!("explain verbose select surface_id from {table} where surface_id >= '{surface}'"),
        format!("explain analyze select count(surface_id) from {table} where surface_id > 'a'"),
        format!("explain format tree select surface_id from {table}"),
    ]
}

fn past(table: &str, version: u64) -> Vec<String> {
    vec![
        format!("select count(*) as n from {table} version as of {version}"),
        format!("select distinct surface_id from {table} version as of {version} order by 1"),
        format!("select count(*) as n from {table} timestamp as of '2099-01-01'"),
        format!("select max(surface_id) as most from {table} for system_time as of '2099-01-01T00:00:00Z'"),
    ]
}

fn system(HiddenRun { surface, run }: &HiddenRun) -> Vec<String> {
    vec![
        "select * from system.files order by path".to_owned(),
        "select sum(bytes) as bytes, sum(rows) as rows, count(*) as n from system.files".to_owned(),
        format!("select path from system.files where path like '%{surface}%' or run_id = '{run}' order by 1"),
        "select surface_id from system.files group by 1 order by 1".to_owned(),
        "select * from system.ingests order by run_id".to_owned(),
        format!("select version, ingested from system.ingests where surface_id = '{surface}'"),
        "select count(*) as n from system.ingests".to_owned(),
        "select \"table\", max(version) as newest, count(*) as n from system.versions group by 1 order by 1".to_owned(),
        "select sum(files_added) as files, sum(rows_added) as rows from system.versions".to_owned(),
        "select * from system.inbox order by path".to_owned(),
        "select count(*) as n, sum(bytes) as bytes from system.inbox".to_owned(),
        "select max(committed) as latest from system.versions where \"table\" = 'runs'".to_owned(),
    ]
}

fn files(HiddenRun { surface, run }: &HiddenRun) -> Vec<String> {
    let patterns = [
        surface.clone(),
        run.clone(),
        format!("runs/{surface}/{run}.mcap"),
        format!("{}*", &surface[..3]),
        format!("?{}", &surface[1..]),
        "*".to_owned(),
        format!("flat,{surface}"),
    ];
    patterns
        .iter()
        .flat_map(|pattern| {
            [
                format!("select * from mcap_topics('{pattern}') order by 1, 2, 3"),
                format!("select count(*) as n from mcap_messages('{pattern}')"),
                format!("select count(*) as n from mcap('{pattern}', '/ir')"),
            ]
        })
        .collect()
}

/// Addresses of HTTP; `file` is a file of table `nce` with hidden rows.
pub(super) fn addresses(HiddenRun { surface, run }: &HiddenRun, file: &str) -> Vec<String> {
    let mut all = vec![
        "/api/v1/lake".to_owned(),
        "/api/v1/map".to_owned(),
        "/api/v1/map.svg".to_owned(),
        "/api/v1/map.svg?format=pdf".to_owned(),
        "/api/v1/correlations".to_owned(),
        "/api/v1/files".to_owned(),
        "/api/v1/files?table=runs&table=nce".to_owned(),
        format!("/api/v1/tables/nce/{file}"),
    ];
    all.extend(
        ["surfaces", "runs", "measurements", "nce", "heightmaps"].map(|table| format!("/api/v1/tables/{table}")),
    );
    all.extend(
        ["", "?sort=surface_id&order=desc", "?sort=level", "?origin=simulated", "?relief=0..1000"]
            .map(|query| format!("/api/v1/surfaces{query}")),
    );
    all.push(format!("/api/v1/surfaces?q={surface}"));
    all.extend(["", "?sort=started", "?limit=1", "?sort=file_bytes"].map(|query| format!("/api/v1/runs{query}")));
    all.extend([format!("/api/v1/runs?q={surface}"), format!("/api/v1/runs?surface_id={surface}")]);
    let of_surface = [
        "",
        "/curves",
        "/curves.svg",
        "/grid?microphone=0",
        "/grid.svg?microphone=0",
        "/heightmap",
        "/mesh.glb",
        "/thumbnail.png",
        "/pairs/7",
        "/pairs/7/analysis",
        "/pairs/7/spectrogram?signal=measured",
        "/pairs/7/ir.wav",
    ];
    all.extend(of_surface.map(|path| format!("/api/v1/surfaces/{surface}{path}")));
    all.extend([
        format!("/api/v1/surfaces/flat/curves.svg?beside={surface}"),
        format!("/api/v1/surfaces/flat/grid.svg?microphone=0&beside={surface}"),
        format!("/api/v1/surfaces/flat/grid.svg?microphone=0&less={surface}"),
    ]);
    all.extend(["", "/environment", "/file.mcap"].map(|path| format!("/api/v1/runs/{run}{path}")));
    let predicates = ["pair_id%3C3".to_owned(), format!("surface_id%3D%27{surface}%27")];
    for predicate in predicates {
        all.push(format!("/api/v1/slices.mcap?where={predicate}"));
        all.push(format!("/api/v1/foxglove/manifest?where={predicate}"));
    }
    all.push(format!("/api/v1/slices.mcap?run={run}"));
    all.push(format!("/api/v1/foxglove/manifest?where=pair_id%3C3&run={run}"));
    all
}

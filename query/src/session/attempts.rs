//! Three hundred attempts to bypass the gate, modelled on known escapes from other systems.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Text that must never be in an answer.
pub(crate) const SECRET: &str = "a4c1f0d2_nobody_may_read_this";

/// Reads every file below a folder, to detect effects of an attempt.
pub(crate) fn files(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut all = BTreeMap::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(&folder).expect("a folder").flatten() {
            match entry.path() {
                path if path.is_dir() => folders.push(path),
                path => drop(all.insert(path.clone(), std::fs::read(path).expect("a file"))),
            }
        }
    }
    all
}

/// Attempts that would read `secret`, write under `outside`, or change the lake or another session.
pub(crate) fn attempts(secret: &Path, outside: &Path) -> Vec<String> {
    let mut all = read_attempts(&secret.display().to_string());
    all.extend(write_attempts(&outside.display().to_string()));
    all.extend(change_attempts());
    all.extend(setting_attempts(&outside.display().to_string()));
    all.extend(pattern_attempts(&secret.display().to_string()));
    let hidden: Vec<_> = all.iter().filter(|a| !a.contains(';')).step_by(3).flat_map(|a| wrap_attempt(a)).collect();
    all.extend(hidden);
    all.sort();
    all.dedup();
    all
}

fn read_attempts(secret: &str) -> Vec<String> {
    let up = format!("../../../../../../../../..{secret}");
    let places = [
        secret.to_owned(),
        format!("file://{secret}"),
        up,
        format!("/proc/self/root{secret}"),
        "/etc/passwd".to_owned(),
    ];
    let mut all = Vec::new();
    for place in &places {
        all.push(format!("select * from '{place}'"));
        all.push(format!("select * from \"{place}\""));
        all.push(format!("table \"{place}\""));
        for function in [
            "read_csv",
            "read_csv_auto",
            "read_parquet",
            "parquet_scan",
            "read_json",
            "read_text",
            "read_blob",
            "glob",
            "csv_scan",
            "delta_scan",
            "sniff_csv",
            "parquet_metadata",
            "arrow_scan",
            "url_table",
            "file",
            "s3",
        ] {
            all.push(format!("select * from {function}('{place}')"));
        }
        for function in ["pg_read_file", "pg_read_binary_file", "pg_ls_dir", "pg_stat_file", "lo_import", "load_file"] {
            all.push(format!("select {function}('{place}')"));
        }
    }
    for url in ["http://127.0.0.1:9/x.csv", "https://example.org/x.parquet", "s3://bucket/x", "gs://b/x", "hdfs://h/x"]
    {
        all.push(format!("select * from '{url}'"));
        all.push(format!("create external table x stored as csv location '{url}'"));
    }
    all
}

fn write_attempts(outside: &str) -> Vec<String> {
    let mut all = Vec::new();
    for format in ["csv", "parquet", "json", "arrow"] {
        let file = format!("{outside}/written.{format}");
        all.push(format!("copy (select 1) to '{file}'"));
        all.push(format!("copy runs to '{file}'"));
        all.push(format!("copy (select 1) to '{file}' stored as {format}"));
        all.push(format!("copy (select 1) to '{file}' (format {format})"));
        all.push(format!("explain analyze copy (select 1) to '{file}'"));
        all.push(format!("create external table x (a int) stored as {format} location '{file}'"));
        all.push(format!("export database '{file}'"));
        all.push(format!("unload ('select 1') to '{file}'"));
        all.push(format!("select 1 into outfile '{file}'"));
        all.push(format!("insert overwrite directory '{file}' select 1"));
        all.push(format!("insert into '{file}' values (1)"));
        all.push(format!("backup database to '{file}'"));
    }
    all.push(format!("copy runs to program 'touch {outside}/program'"));
    all.push(format!("copy runs from program 'touch {outside}/program'"));
    all.push(format!("copy runs from '{outside}/nothing'"));
    all.push(format!("select lo_export(1, '{outside}/large')"));
    all.push(format!("select pg_file_write('{outside}/file', 'x', false)"));
    all.push(format!("do $$ begin perform pg_file_write('{outside}/do', 'x', false); end $$"));
    all.push(format!("attach '{outside}/attached.db' as other"));
    all.push(format!("load '{outside}/module.so'"));
    all.push(format!("create function f() returns int language c as '{outside}/module.so', 'f'"));
    all.push(format!("create tablespace t location '{outside}'"));
    all
}

fn change_attempts() -> Vec<String> {
    let mut all: Vec<String> = Vec::new();
    for table in ["runs", "measurements", "tnce", "points", "information_schema.tables", "pg_catalog.pg_class"] {
        for text in [
            "drop table T",
            "drop view T",
            "truncate table T",
            "delete from T",
            "alter table T rename to gone",
            "alter table T add column x int",
            "insert into T select * from T",
            "update T set run_id = 'x'",
            "create index i on T (run_id)",
            "create or replace view T as select 1",
            "create or replace table T as select 1",
            "merge into T using (select 1 a) s on true when matched then delete",
            "lock table T in exclusive mode",
            "comment on table T is 'x'",
            "grant all on T to public",
            "vacuum T",
            "optimize table T",
            "analyze T",
            "with x as (insert into T select * from T returning *) select * from x",
            "select * into gone from T",
            "refresh materialized view T",
            "cluster T",
        ] {
            all.push(text.replace('T', table));
        }
    }
    for text in [
        "create schema s",
        "drop schema public cascade",
        "drop database datafusion",
        "create database d",
        "create role r",
        "create table t as select 1",
        "create temporary table t (a int)",
        "create view v as select 1",
        "create function f(x int) returns int return x + 1",
        "drop function sum",
        "create sequence s",
        "create type t as (a int)",
        "create extension dblink",
        "install httpfs",
        "pragma database_list",
        "call system('id')",
        "exec xp_cmdshell 'id'",
        "listen x",
        "notify x",
        "checkpoint",
        "reindex database d",
        "drop owned by postgres",
        "alter system set x = 1",
        "kill 1",
        "shutdown",
        "use other",
        "prepare p as drop table runs",
        "execute p",
        "declare c cursor for delete from runs",
    ] {
        all.push(text.to_owned());
    }
    all
}

fn setting_attempts(outside: &str) -> Vec<String> {
    let mut all = Vec::new();
    for (name, value) in [
        ("datafusion.runtime.memory_limit", "900G"),
        ("datafusion.runtime.temp_directory", outside),
        ("datafusion.catalog.location", outside),
        ("datafusion.catalog.format", "CSV"),
        ("datafusion.catalog.information_schema", "false"),
        ("datafusion.execution.target_partitions", "100000"),
        ("datafusion.execution.batch_size", "1000000000"),
        ("datafusion.sql_parser.recursion_limit", "1000000"),
        ("datafusion.execution.parquet.pruning", "false"),
        ("datafusion.runtime.max_temp_directory_size", "900G"),
        ("role", "postgres"),
        ("session_authorization", "postgres"),
        ("search_path", "pg_temp"),
    ] {
        all.push(format!("set {name} = '{value}'"));
        all.push(format!("set session {name} to '{value}'"));
        all.push(format!("select set_config('{name}', '{value}', false)"));
        all.push(format!("reset {name}"));
    }
    all
}

// Names of surfaces, runs and topics that are paths, invalid patterns, broken quotes.
fn pattern_attempts(secret: &str) -> Vec<String> {
    let mut all = Vec::new();
    for name in [
        secret.to_owned(),
        format!("../../../../../..{secret}"),
        format!("runs/../../../../..{secret}"),
        "..%2f..%2f..%2fetc%2fpasswd".to_owned(),
        "runs/..\\..\\etc\\passwd".to_owned(),
        "file:///etc/passwd".to_owned(),
        "http://127.0.0.1:9/x.mcap".to_owned(),
        "lake.toml".to_owned(),
        "tables/runs/_delta_log/00000000000000000000.json".to_owned(),
        "x''; drop table runs; --".to_owned(),
        "\u{0}".to_owned(),
        "*/../*".to_owned(),
        "[[[[".to_owned(),
        "(a+)+$".to_owned(),
    ] {
        all.push(format!("select * from mcap('{name}', '/ir')"));
        all.push(format!("select * from mcap_topics('{name}')"));
        all.push(format!("select * from mcap_messages('{name}')"));
        all.push(format!("select * from runs where run_id = '{name}'; drop table runs"));
    }
    all
}

// The same after a statement that reads.
fn wrap_attempt(attempt: &str) -> [String; 4] {
    [
        format!("select 1; {attempt}"),
        format!("explain analyze {attempt}"),
        format!("/* select */ {attempt} -- select"),
        format!("with a as (select 1) {attempt}"),
    ]
}

#[test]
fn there_are_three_hundred_of_them() {
    let all = attempts(Path::new("/secret"), Path::new("/outside"));
    assert!(all.len() >= 300, "{}", all.len());
}

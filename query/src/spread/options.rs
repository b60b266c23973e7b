//! The limit of memory and the options that a task takes from the session of its query. They cross the wire
//! as an extension of the configuration.

use std::collections::BTreeMap;

use datafusion::common::config::ConfigOptions;
use datafusion::common::extensions_options;
use datafusion::config::ConfigExtension;
use datafusion::error::{DataFusionError, Result};

/// Options that a session may change and workers take over: keys, and beginnings of keys that end in a dot.
const CARRIED: [&str; 3] =
    ["datafusion.execution.time_zone", "datafusion.execution.batch_size", "datafusion.execution.parquet."];
/// Beginning of the options that matter while a plan runs. All others are of parsing and planning, which is done here.
const OF_EXECUTION: &str = "datafusion.execution.";
/// Limit of a batch's rows: memory is counted by batches.
const BATCH_ROWS_LIMIT: usize = 1 << 16;

extensions_options! {
    /// Limit and options that a task takes from its query's session.
    pub(super) struct TaskOptions {
        /// Bytes that the task's operators may hold; 0 for no limit.
        pub memory_bytes: usize, default = 0
        /// The session's options that are not those of every query, as a JSON object.
        pub session: String, default = "{}".to_owned()
    }
}

impl ConfigExtension for TaskOptions {
    const PREFIX: &'static str = "echolake_task";
}

impl TaskOptions {
    /// Takes what the options of a query's session have changed of those of every query, which workers have, too. The
    /// error is the reason for which workers cannot run it.
    ///
    /// # Errors
    /// An option is changed that workers do not take over.
    pub fn from_session(
        own: &ConfigOptions,
        session: &ConfigOptions,
        memory_bytes: Option<usize>,
    ) -> std::result::Result<Self, String> {
        let known: BTreeMap<_, _> = own.entries().into_iter().map(|entry| (entry.key, entry.value)).collect();
        let mut changed = BTreeMap::new();
        for entry in session.entries() {
            if !entry.key.starts_with(OF_EXECUTION) || known.get(&entry.key) == Some(&entry.value) {
                continue;
            }
            match entry.value.filter(|_| is_carried(&entry.key)) {
                Some(value) => drop(changed.insert(entry.key, value)),
                None => return Err(format!("workers do not take over the option {}", entry.key)),
            }
        }
        let session = serde_json::to_string(&changed).map_err(|e| e.to_string())?;
        Ok(Self { memory_bytes: memory_bytes.unwrap_or(0), session })
    }

    /// Returns the limit of a task's memory, bytes.
    pub fn memory_limit(&self) -> Option<usize> {
        (self.memory_bytes > 0).then_some(self.memory_bytes)
    }

    /// Changes the options of every query into those of the session.
    ///
    /// # Errors
    /// An option that no session changes, or a value that it does not have.
    pub fn apply_to(&self, options: &mut ConfigOptions) -> Result<()> {
        let wrong = |what: String| DataFusionError::Configuration(format!("the session's options: {what}"));
        let changed: BTreeMap<String, String> =
            serde_json::from_str(&self.session).map_err(|e| wrong(e.to_string()))?;
        for (key, value) in changed {
            if !is_carried(&key) {
                return Err(wrong(format!("`{key}` is none that a session changes")));
            }
            options.set(&key, &value)?;
        }
        match options.execution.batch_size.get() {
            1..=BATCH_ROWS_LIMIT => Ok(()),
            rows => Err(wrong(format!("batches of {rows} rows, expected 1 to {BATCH_ROWS_LIMIT}"))),
        }
    }
}

fn is_carried(key: &str) -> bool {
    CARRIED.iter().any(|carried| key == *carried || (carried.ends_with('.') && key.starts_with(carried)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_of_a_session_are_those_of_its_tasks() {
        let mut own = ConfigOptions::new();
        own.execution.time_zone = Some("UTC".to_owned());
        let mut session = own.clone();
        session.execution.time_zone = Some("Europe/Zurich".to_owned());
        session.set("datafusion.execution.batch_size", "77").expect("an option");
        session.execution.parquet.pushdown_filters = !own.execution.parquet.pushdown_filters;
        session.sql_parser.collect_spans = true;
        let task = TaskOptions::from_session(&own, &session, Some(1000)).expect("options");
        assert_eq!(task.memory_limit(), Some(1000));
        let mut applied = own.clone();
        task.apply_to(&mut applied).expect("they are carried");
        let text = |options: &ConfigOptions| format!("{:?}", options.execution);
        assert_eq!(text(&applied), text(&session));

        session.execution.keep_partition_by_columns = true;
        let reason = TaskOptions::from_session(&own, &session, None).expect_err("not carried");
        assert!(reason.contains("datafusion.execution.keep_partition_by_columns"), "{reason}");
    }

    #[test]
    fn options_from_strangers_are_refused() {
        for session in [
            "no json",
            r#"{"datafusion.runtime.memory_limit": "9T"}"#,
            r#"{"datafusion.execution.target_partitions": "1000000"}"#,
            r#"{"datafusion.execution.batch_size": "1000000000"}"#,
            r#"{"datafusion.execution.batch_size": "0"}"#,
            r#"{"datafusion.execution.batch_size": "many"}"#,
        ] {
            let task = TaskOptions { session: session.to_owned(), ..TaskOptions::default() };
            assert!(task.apply_to(&mut ConfigOptions::new()).is_err(), "{session}");
        }
    }
}

//! A session's settings: those that change nothing, or that the server keeps to. All others are refused, because a
//! client that sets one relies on it.

use std::collections::BTreeMap;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use echolake_schema::quoted_text;
use echolake_service::RequestFault;

/// The server's version as shown to clients, which compare the first word.
pub(super) const VERSION: &str = concat!("16.6 (echolake ", env!("CARGO_PKG_VERSION"), ")");
/// Characters of a setting.
const LONGEST: usize = 1000;

/// The allowed changes of a setting.
#[derive(Debug, Clone, Copy)]
enum AllowedChange {
    /// Nothing: it is a fact.
    Read,
    /// Set it to anything: it changes nothing here.
    Set,
    /// Set it to one of these, which are what the server does anyway.
    Keep(&'static [&'static str]),
    /// Set it to a time.
    Time,
}

const ON: &[&str] = &["on", "true", "yes", "1"];
const ISOLATION: &[&str] = &["serializable", "repeatable read", "read committed", "read uncommitted"];

/// Each setting in lower case, as it is shown, what it is at first, and what may be done.
const KNOWN: [(&str, &str, AllowedChange); 38] = [
    ("application_name", "", AllowedChange::Set),
    ("backslash_quote", "safe_encoding", AllowedChange::Read),
    ("bytea_output", "hex", AllowedChange::Keep(&["hex"])),
    ("check_function_bodies", "on", AllowedChange::Set),
    ("client_encoding", "UTF8", AllowedChange::Keep(&["utf8", "utf-8", "unicode"])),
    ("client_min_messages", "notice", AllowedChange::Set),
    ("datestyle", "ISO, YMD", AllowedChange::Set),
    ("default_table_access_method", "heap", AllowedChange::Read),
    ("default_tablespace", "", AllowedChange::Set),
    ("default_transaction_isolation", "repeatable read", AllowedChange::Keep(ISOLATION)),
    ("default_transaction_read_only", "on", AllowedChange::Keep(ON)),
    ("escape_string_warning", "on", AllowedChange::Set),
    ("extra_float_digits", "1", AllowedChange::Set),
    ("geqo", "off", AllowedChange::Set),
    ("idle_in_transaction_session_timeout", "0", AllowedChange::Set),
    ("in_hot_standby", "off", AllowedChange::Read),
    ("integer_datetimes", "on", AllowedChange::Read),
    ("intervalstyle", "postgres", AllowedChange::Keep(&["postgres"])),
    ("is_superuser", "off", AllowedChange::Read),
    ("jit", "off", AllowedChange::Set),
    ("lc_collate", "C", AllowedChange::Read),
    ("lc_ctype", "C", AllowedChange::Read),
    ("lock_timeout", "0", AllowedChange::Set),
    ("max_identifier_length", "63", AllowedChange::Read),
    ("max_index_keys", "32", AllowedChange::Read),
    ("row_security", "on", AllowedChange::Set),
    ("search_path", "public", AllowedChange::Set),
    ("server_encoding", "UTF8", AllowedChange::Read),
    ("server_version", VERSION, AllowedChange::Read),
    ("server_version_num", "160006", AllowedChange::Read),
    ("session_authorization", "", AllowedChange::Read),
    ("standard_conforming_strings", "on", AllowedChange::Keep(ON)),
    ("statement_timeout", "0", AllowedChange::Time),
    ("synchronize_seqscans", "on", AllowedChange::Set),
    ("timezone", "UTC", AllowedChange::Set),
    ("transaction_isolation", "repeatable read", AllowedChange::Keep(ISOLATION)),
    ("transaction_read_only", "on", AllowedChange::Keep(ON)),
    ("xmloption", "content", AllowedChange::Set),
];

/// The settings of a session.
#[derive(Debug, Default)]
pub(super) struct SessionSettings(Mutex<BTreeMap<&'static str, String>>);

impl SessionSettings {
    /// Sets one.
    pub fn set_value(&self, name: &str, value: &str) -> Result<(), RequestFault> {
        let (name, _, may) = find_setting(name)?;
        let value = value.trim();
        let allowed = match may {
            AllowedChange::Read => false,
            AllowedChange::Set => value.chars().count() <= LONGEST,
            AllowedChange::Keep(values) => values.iter().any(|v| value.eq_ignore_ascii_case(v)),
            AllowedChange::Time => parse_duration(value).is_some(),
        };
        if !allowed {
            return Err(RequestFault::bad_request(format!("`{name}` cannot be set to `{}` here", quoted_text(value))));
        }
        // What is kept to stays as it is shown; times and words are shown as they were set.
        if matches!(may, AllowedChange::Set | AllowedChange::Time) {
            self.0.lock().unwrap_or_else(PoisonError::into_inner).insert(name, value.to_owned());
        }
        Ok(())
    }

    /// Stores the user name, as the client gave it at login.
    pub fn set_user(&self, user: &str) {
        let user = user.chars().take(LONGEST).collect();
        self.0.lock().unwrap_or_else(PoisonError::into_inner).insert("session_authorization", user);
    }

    /// One of them.
    pub fn get(&self, name: &str) -> Result<String, RequestFault> {
        let (name, value, _) = find_setting(name)?;
        let set = self.0.lock().unwrap_or_else(PoisonError::into_inner).get(name).cloned();
        Ok(set.unwrap_or_else(|| value.to_owned()))
    }

    /// All of them.
    pub fn all_values(&self) -> Vec<(&'static str, String)> {
        KNOWN.iter().map(|(name, value, _)| (*name, self.get(name).unwrap_or_else(|_| (*value).to_owned()))).collect()
    }

    /// One as it was at first, or all of them.
    pub fn reset_values(&self, name: Option<&str>) -> Result<(), RequestFault> {
        let name = name.map(find_setting).transpose()?.map(|(name, ..)| name);
        let keeps = |known: &&str| *known == "session_authorization" || name.is_some_and(|n| n != *known);
        self.0.lock().unwrap_or_else(PoisonError::into_inner).retain(|known, _| keeps(known));
        Ok(())
    }

    /// The session's own limit of a query's time.
    pub fn statement_timeout(&self) -> Option<Duration> {
        self.get("statement_timeout").ok().and_then(|v| parse_duration(&v)).filter(|t| !t.is_zero())
    }
}

fn find_setting(name: &str) -> Result<(&'static str, &'static str, AllowedChange), RequestFault> {
    let lower = name.to_ascii_lowercase();
    let found = KNOWN.iter().find(|(known, ..)| *known == lower);
    found.copied().ok_or_else(|| RequestFault::NotFound {
        what: format!("the setting `{}`", quoted_text(name)),
        hint: "SHOW ALL lists them",
    })
}

// A number is of milliseconds; units as in Postgres.
fn parse_duration(value: &str) -> Option<Duration> {
    let value = value.trim();
    let end = value.find(|c: char| !c.is_ascii_digit()).unwrap_or(value.len());
    let number: u64 = value[..end].parse().ok()?;
    let millis = match value[end..].trim() {
        "" | "ms" => 1,
        "s" => 1_000,
        "min" => 60_000,
        "h" => 3_600_000,
        "d" => 86_400_000,
        _ => return None,
    };
    // As long as Postgres allows.
    number.checked_mul(millis).filter(|ms| *ms <= i32::MAX as u64).map(Duration::from_millis)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_changes_nothing_may_be_set_and_nothing_else() {
        let settings = SessionSettings::default();
        for (name, value) in [
            ("application_name", "psql"),
            ("DateStyle", "ISO"),
            ("client_encoding", "UTF-8"),
            ("default_transaction_read_only", "on"),
            ("TimeZone", "Europe/Zurich"),
        ] {
            settings.set_value(name, value).expect(name);
        }
        for (name, value) in [
            ("client_encoding", "LATIN1"),
            ("default_transaction_read_only", "off"),
            ("bytea_output", "escape"),
            ("server_version", "9"),
            ("datafusion.runtime.memory_limit", "900G"),
            ("work_mem", "1GB"),
            ("statement_timeout", "soon"),
            ("statement_timeout", "-1"),
            ("statement_timeout", "9999999999999999999"),
        ] {
            assert!(settings.set_value(name, value).is_err(), "{name} = {value}");
        }
        assert_eq!(settings.get("Application_Name").expect("set"), "psql");
        settings.reset_values(Some("application_name")).expect("reset");
        assert_eq!(settings.get("application_name").expect("reset"), "");
        assert_eq!(settings.get("timezone").expect("set"), "Europe/Zurich");
        settings.reset_values(None).expect("reset");
        assert_eq!(settings.get("timezone").expect("reset"), "UTC");
        assert!(KNOWN.is_sorted_by_key(|(name, ..)| *name));
    }

    #[test]
    fn times_have_units() {
        let settings = SessionSettings::default();
        assert_eq!(settings.statement_timeout(), None);
        for (value, millis) in [("250", 250), ("500ms", 500), ("2s", 2_000), (" 1 min", 60_000)] {
            settings.set_value("statement_timeout", value).expect(value);
            assert_eq!(settings.statement_timeout(), Some(Duration::from_millis(millis)), "{value}");
        }
        settings.set_value("statement_timeout", "0").expect("set");
        assert_eq!(settings.statement_timeout(), None);
    }
}

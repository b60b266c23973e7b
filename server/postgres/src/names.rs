//! Names of the only role, and of types: Postgres has a short one for `pg_type` and a long one for SQL.

/// The only role; `pg_get_userbyid`, `session_user` and `user` return the same.
pub(super) const ROLE: &str = "postgres";
/// The type of the catalogue's numbers, and the name of the elements of their lists.
pub(super) const OID: &str = "oid";

/// Short and long names of types.
const TYPES: [(&str, &str); 11] = [
    ("bool", "boolean"),
    ("int2", "smallint"),
    ("int4", "integer"),
    ("int8", "bigint"),
    ("float4", "real"),
    ("float8", "double precision"),
    ("timestamp", "timestamp without time zone"),
    ("timestamptz", "timestamp with time zone"),
    ("time", "time without time zone"),
    ("varchar", "character varying"),
    ("char", "\"char\""),
];

/// Returns a type's name as SQL writes it, from its name in `pg_type`.
pub(super) fn long_type_name(short: &str) -> String {
    if let Some(element) = short.strip_prefix('_') {
        return format!("{}[]", long_type_name(element));
    }
    TYPES.iter().find(|(known, _)| *known == short).map_or(short, |(_, long)| long).to_owned()
}

/// Returns a type's name in `pg_type`, from its name in SQL.
pub(super) fn short_type_name(name: &str) -> &str {
    match name {
        "int" => "int4",
        "decimal" => "numeric",
        other => TYPES.iter().find(|(_, long)| *long == other).map_or(other, |(short, _)| short),
    }
}

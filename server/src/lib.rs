//! The query service: HTTP, Arrow Flight SQL and Postgres wire, all behind one gate.

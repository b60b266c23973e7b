//! What the protocols of a server share: the query engine and its client, queries that run, failures with their codes,
//! spans of requests, and what an engine and its door tell each other.

mod activity;
pub mod authorization;
mod client_identity;
mod connection_opening;
mod contribution_draft;
mod door_message;
mod door_rows;
mod engine_report;
mod engine_role;
mod engine_services;
mod engine_socket;
mod error;
mod fault;
mod query_watch;
mod request_number;
pub mod request_span;
#[cfg(feature = "otlp")]
mod request_trace;
pub mod running;
mod server_protocol;
mod service;
mod stop_signal;
mod token_scope;

pub use activity::{
    ActivityRows, ActivityTable, FolderFigures, LakeFigures, LoggedQuery, OpenConnection, QueryEnd, QueryStart,
};
pub use client_identity::{ClientIdentity, counted_bytes};
pub use connection_opening::ConnectionOpening;
pub use contribution_draft::ContributionDraft;
pub use door_message::DoorMessage;
pub use engine_report::{EngineCulprit, EngineEnd, EngineReport};
pub use engine_role::EngineRole;
pub use engine_services::{EngineServices, ServedClient, mark_client};
pub use engine_socket::EngineSocket;
pub use error::Error;
pub use fault::{FaultCode, FaultParts, RequestFault};
pub use query_watch::{QueryTimer, QueryWatch};
pub use request_number::answer_numbered;
pub use server_protocol::ServerProtocol;
pub use service::{CATALOG, QueryJob, QueryService, QueryWork, SCHEMA};
pub use stop_signal::StopSignal;
pub use token_scope::TokenScope;

//! Startup of a connection: the door has checked who it is; the client's settings are those that it begins with.

use std::fmt::Debug;
use std::sync::Arc;

use async_trait::async_trait;
use echolake_service::{RequestFault, TokenScope, request_span};
use futures::Sink;
use pgwire::api::auth::{
    DefaultServerParameterProvider, StartupHandler, finish_authentication, protocol_negotiation,
    save_startup_parameters_to_metadata,
};
use pgwire::api::{ClientInfo, METADATA_USER, PgWireConnectionState};
use pgwire::error::{PgWireError, PgWireResult};
use pgwire::messages::{PgWireBackendMessage, PgWireFrontendMessage, ProtocolVersion};

use super::PID_PARAMETER;
use super::connection::PostgresConnection;
use super::settings::VERSION;
use super::sqlstate::fatal_error;

/// Logs in.
pub(super) struct LoginHandler(pub Arc<PostgresConnection>);

#[async_trait]
impl StartupHandler for LoginHandler {
    async fn on_startup<C>(&self, client: &mut C, message: PgWireFrontendMessage) -> PgWireResult<()>
    where
        C: ClientInfo + Sink<PgWireBackendMessage> + Unpin + Send + Sync,
        C::Error: Debug,
        PgWireError: From<<C as Sink<PgWireBackendMessage>>::Error>,
    {
        match message {
            PgWireFrontendMessage::Startup(startup) => {
                protocol_negotiation(client, &startup).await?;
                save_startup_parameters_to_metadata(client, &startup);
                self.begin_with(client.metadata()).map_err(|fault| fatal_error(&fault))?;
                client.set_state(PgWireConnectionState::AuthenticationInProgress);
                self.let_in(client).await
            }
            _ => Err(fatal_error(&RequestFault::bad_request("the protocol's startup is expected"))),
        }
    }
}

impl LoginHandler {
    async fn let_in<C>(&self, client: &mut C) -> PgWireResult<()>
    where
        C: ClientInfo + Sink<PgWireBackendMessage> + Unpin + Send + Sync,
        C::Error: Debug,
        PgWireError: From<<C as Sink<PgWireBackendMessage>>::Error>,
    {
        let service = &self.0.shared().service;
        let who = service.authorised_client(TokenScope::Sql).map_err(|fault| fatal_error(&fault))?;
        let wide = client.protocol_version() != ProtocolVersion::PROTOCOL3_0;
        let given = client.metadata().get(PID_PARAMETER).and_then(|pid| pid.parse().ok());
        let (pid, key) = self.0.log_in(&who, given, wide).map_err(|fault| fatal_error(&fault))?;
        client.set_pid_and_secret_key(pid, key);
        let mut parameters = DefaultServerParameterProvider::default();
        parameters.server_version = VERSION.to_owned();
        parameters.is_superuser = false;
        parameters.default_transaction_read_only = true;
        parameters.time_zone = "UTC".to_owned();
        finish_authentication(client, &parameters).await
    }

    // `options` may carry settings, as in `-c statement_timeout=5s`.
    fn begin_with(&self, given: &std::collections::HashMap<String, String>) -> Result<(), RequestFault> {
        let settings = &self.0.settings;
        if let Some(number) = given.get(request_span::PARAMETER) {
            request_span::record_connection(number);
        }
        if given.get("replication").is_some_and(|v| v != "false" && v != "off" && v != "0") {
            return Err(RequestFault::unsupported("replication"));
        }
        if let Some(user) = given.get(METADATA_USER) {
            settings.set_user(user);
        }
        // A setting that a driver always sends is applied if it is known, and is no reason to refuse the client.
        for (name, value) in given {
            let _ = settings.set_value(name, value);
        }
        let words: Vec<_> = given.get("options").map(|o| o.split_whitespace().collect()).unwrap_or_default();
        let mut words = words.into_iter();
        while let Some(word) = words.next() {
            let pair = match word.strip_prefix("--").or_else(|| word.strip_prefix("-c")) {
                Some("") => words.next(),
                pair => pair,
            };
            let (name, value) = pair
                .and_then(|p| p.split_once('='))
                .ok_or_else(|| RequestFault::bad_request(format!("`{word}` is no option; hint: -c name=value")))?;
            settings.set_value(name, value)?;
        }
        Ok(())
    }
}

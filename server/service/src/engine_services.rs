//! The clients of an engine, which all of them share: the door names the client of each request, and what an engine
//! keeps for a client is kept under that name and those rights alone.

use std::any::{Any, TypeId};
use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::time::Duration;

use axum::http::{HeaderMap, HeaderName, HeaderValue};
use echolake_lake::Lake;
use echolake_query::{EngineClient, QueryEngine, QueryThreads};
use quick_cache::sync::Cache;
use tokio::sync::mpsc;

use crate::Error;
use crate::client_identity::ClientIdentity;
use crate::door_message::DoorMessage;
use crate::door_rows::DoorRows;
use crate::fault::RequestFault;
use crate::query_watch::RunningWatches;
use crate::service::{QueryService, SharedService};

/// Header of a request from the door to an engine: its client, as [`ClientIdentity::to_text`] writes it.
const CLIENT: HeaderName = HeaderName::from_static("echolake-client");
/// Clients for whom an engine keeps something; of others it forgets what can be made again.
const KEPT_CLIENTS: usize = 128;

/// Names the client of a request; whatever the client itself sent under that header is replaced.
///
/// # Errors
/// [`RequestFault::Internal`] if a header cannot hold the client's name, which is a defect.
pub fn mark_client(headers: &mut HeaderMap, client: &ClientIdentity) -> Result<(), RequestFault> {
    let text = HeaderValue::from_bytes(client.to_text().as_bytes());
    headers.insert(CLIENT, text.map_err(RequestFault::defect("a client's name fits no header"))?);
    Ok(())
}

/// The clients of an engine. Clones are the same.
#[derive(Clone)]
pub struct EngineServices(Arc<ServicesState>);

struct ServicesState {
    shared: Arc<SharedService>,
    clients: Cache<String, Arc<ServedClient>>,
    /// Quotas of clients that are in use, so that forgetting a client does not give it a second one.
    quotas: Mutex<HashMap<String, Weak<EngineClient>>>,
}

/// A client of an engine, with what protocols keep for it.
pub struct ServedClient {
    service: QueryService,
    states: Mutex<HashMap<TypeId, Arc<dyn Any + Send + Sync>>>,
}

impl EngineServices {
    /// The clients of an engine on a lake; queries that take as long as `slow` are logged.
    ///
    /// # Errors
    /// [`Error::System`].
    pub fn new(lake: &Lake, engine: QueryEngine, slow: Option<Duration>) -> Result<Self, Error> {
        let shared = SharedService {
            lake: lake.clone(),
            engine,
            watches: Arc::new(RunningWatches::new(slow)),
            door_rows: Arc::new(DoorRows::default()),
            encoders: QueryThreads::per_core("encode").map_err(Error::System)?,
        };
        let clients = Cache::new(KEPT_CLIENTS);
        Ok(Self(Arc::new(ServicesState { shared: Arc::new(shared), clients, quotas: Mutex::default() })))
    }

    /// Finds the client of a request that the door has marked.
    ///
    /// # Errors
    /// [`RequestFault::Internal`] if it names none: an engine answers nobody by default.
    pub fn client_of_request(&self, headers: &HeaderMap) -> Result<Arc<ServedClient>, RequestFault> {
        let mut named = headers.get_all(CLIENT).iter();
        let (Some(only), None) = (named.next(), named.next()) else { return Err(RequestFault::Internal) };
        self.find_client(std::str::from_utf8(only.as_bytes()).map_err(RequestFault::defect("a client is no text"))?)
    }

    /// Finds a client by the door's text.
    ///
    /// # Errors
    /// [`RequestFault::Internal`] if the text names none.
    pub fn find_client(&self, text: &str) -> Result<Arc<ServedClient>, RequestFault> {
        self.0.clients.get_or_insert_with(text, || {
            let identity = ClientIdentity::parse_text(text)?;
            let client = self.engine_client(text, &identity);
            let service = QueryService::new(&self.0.shared, identity, client)?;
            Ok(Arc::new(ServedClient { service, states: Mutex::default() }))
        })
    }

    fn engine_client(&self, text: &str, identity: &ClientIdentity) -> Arc<EngineClient> {
        let mut quotas = self.0.quotas.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(client) = quotas.get(text).and_then(Weak::upgrade) {
            return client;
        }
        quotas.retain(|_, client| client.strong_count() > 0);
        let client = Arc::new(EngineClient::new(identity.name.clone(), identity.quota()));
        quotas.insert(text.to_owned(), Arc::downgrade(&client));
        client
    }

    /// Does what the door says; ends with the door.
    pub async fn obey_door(&self, mut messages: mpsc::UnboundedReceiver<DoorMessage>) {
        let shared = &self.0.shared;
        while let Some(message) = messages.recv().await {
            match message {
                DoorMessage::Cancel(number) => shared.watches.cancel_query(number),
                DoorMessage::Rows { number, rows } => shared.door_rows.take_answer(number, rows),
                DoorMessage::EndClient(name) => shared.engine.cancel_client(&name),
            }
        }
    }

    /// The engine that all clients share.
    pub fn engine(&self) -> &QueryEngine {
        &self.0.shared.engine
    }

    /// The lake, all of it.
    pub fn lake(&self) -> &Lake {
        &self.0.shared.lake
    }
}

impl ServedClient {
    /// The service of this client's requests.
    pub fn service(&self) -> &QueryService {
        &self.service
    }

    /// What a protocol keeps for this client; `make` runs at the first request.
    ///
    /// # Errors
    /// Those of `make`.
    pub fn protocol_state<T: Send + Sync + 'static>(
        &self,
        make: impl FnOnce(&QueryService) -> Result<T, RequestFault>,
    ) -> Result<Arc<T>, RequestFault> {
        let mut states = self.states.lock().unwrap_or_else(PoisonError::into_inner);
        let known = states.get(&TypeId::of::<T>()).cloned().and_then(|state| state.downcast::<T>().ok());
        if let Some(known) = known {
            return Ok(known);
        }
        let made = Arc::new(make(&self.service)?);
        states.insert(TypeId::of::<T>(), made.clone());
        Ok(made)
    }
}

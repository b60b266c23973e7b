//! Connections to a served catalogue over HTTP, plain or encrypted, that are kept open.

use std::io::{BufRead as _, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context as _, Result};
use tokio_rustls::rustls::pki_types::ServerName;
use tokio_rustls::rustls::{ClientConfig, ClientConnection, StreamOwned};

use crate::serve::tunnel::{CERTIFIED_NAME, trusting_config};

/// Time limit for the next bytes of an answer.
const ANSWER_LIMIT: Duration = Duration::from_secs(60);

/// A served catalogue, and how it is asked.
#[derive(Clone)]
pub(crate) struct CatalogueServer {
    address: String,
    /// Lines of each request's head.
    headers: String,
    encryption: Option<Arc<ClientConfig>>,
}

/// A connection that is kept open.
pub(crate) struct CatalogueConnection {
    headers: String,
    stream: BufReader<Box<dyn ByteStream>>,
}

trait ByteStream: Read + Write + Send {}

impl<T: Read + Write + Send> ByteStream for T {}

impl CatalogueServer {
    /// A server at `127.0.0.1:8080`, in plain text, without a token.
    pub fn new(address: &str) -> Self {
        let headers = format!("host: {address}\r\naccept: application/json, */*\r\n");
        Self { address: address.to_owned(), headers, encryption: None }
    }

    /// Sends it a token with each request.
    pub fn with_token(mut self, token: &str) -> Self {
        self.headers += &format!("authorization: Bearer {token}\r\n");
        self
    }

    /// Encrypts, and trusts this certificate alone.
    ///
    /// # Errors
    /// The file is no certificate.
    pub fn with_certificate(mut self, certificate: &Path) -> Result<Self> {
        self.encryption = Some(Arc::new(trusting_config(certificate)?));
        Ok(self)
    }

    /// Connects.
    ///
    /// # Errors
    /// The server does not listen, or is another one.
    pub fn connect(&self) -> Result<CatalogueConnection> {
        let stream = TcpStream::connect(&self.address)?;
        stream.set_nodelay(true)?;
        stream.set_read_timeout(Some(ANSWER_LIMIT))?;
        let stream: Box<dyn ByteStream> = match &self.encryption {
            None => Box::new(stream),
            Some(config) => {
                let name = ServerName::try_from(CERTIFIED_NAME)?;
                Box::new(StreamOwned::new(ClientConnection::new(config.clone(), name)?, stream))
            }
        };
        Ok(CatalogueConnection { headers: self.headers.clone(), stream: BufReader::new(stream) })
    }
}

impl CatalogueConnection {
    /// Asks; returns status and body.
    ///
    /// # Errors
    /// The connection ends, or the answer is none.
    pub fn get(&mut self, path: &str) -> Result<(u16, Vec<u8>)> {
        let head = format!("GET {path} HTTP/1.1\r\n{}\r\n", self.headers);
        self.stream.get_mut().write_all(head.as_bytes())?;
        self.stream.get_mut().flush()?;
        let mut status = 0;
        let mut length = None;
        for line in (&mut self.stream).lines() {
            let line = line?;
            if line.is_empty() {
                break;
            }
            if let Some(rest) = line.strip_prefix("HTTP/1.1 ") {
                status = rest.split(' ').next().unwrap_or_default().parse()?;
            }
            if let Some((name, value)) = line.split_once(": ")
                && name.eq_ignore_ascii_case("content-length")
            {
                length = Some(value.parse::<usize>()?);
            }
        }
        let mut body = vec![0; length.context("an answer without a length")?];
        self.stream.read_exact(&mut body)?;
        Ok((status, body))
    }
}

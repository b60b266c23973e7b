//! A small S3 server in memory: what the client of `object_store` asks for, without signatures, and with faults.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::io::{self, BufRead as _, BufReader, Read as _, Write as _};
use std::net::{TcpListener, TcpStream};
use std::sync::{Arc, Mutex, MutexGuard};

use chrono::{DateTime, Utc};
use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

/// Largest share of an answer that is sent where it is cut off.
const CUT_AT: usize = 2;

/// Behaviour of the server.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum StoreBehaviour {
    /// As S3.
    Faultless,
    /// `If-None-Match` is passed over.
    Overwrites,
    /// Copies of objects that came in parts have one byte changed.
    DamagesCopies,
    /// A fifth of the commits is made and not answered; of the rest a tenth is refused by 503, and a tenth by a 409
    /// that means nothing; a tenth of the listings is cut off, a twentieth of the reads is refused by 503.
    Unreliable(u64),
}

/// The server. It ends with the process.
pub(crate) struct S3Double {
    endpoint: String,
    state: Arc<Mutex<StoreState>>,
}

struct StoreState {
    objects: BTreeMap<String, StoredObject>,
    uploads: BTreeMap<String, BTreeMap<u32, Vec<u8>>>,
    behaviour: StoreBehaviour,
    random: ChaCha8Rng,
    faults: usize,
    requests: usize,
    log: Vec<String>,
    /// Open connections.
    connections: usize,
    /// Parts of uploads that were stored.
    parts: usize,
    /// The number of parts behind which further ones are lost on their way.
    part_limit: usize,
}

#[derive(Clone)]
struct StoredObject {
    bytes: Vec<u8>,
    /// As S3 has it: of an object that came in parts it is another one than of a copy of it.
    e_tag: String,
    modified: DateTime<Utc>,
}

struct HttpRequest {
    method: String,
    /// Without bucket.
    key: String,
    query: BTreeMap<String, String>,
    headers: BTreeMap<String, String>,
    body: Vec<u8>,
}

struct HttpAnswer {
    status: &'static str,
    headers: String,
    body: Vec<u8>,
}

/// A fault that a request meets.
#[derive(Clone, Copy, PartialEq, Eq)]
enum RequestFault {
    None,
    /// It does not arrive.
    Lost,
    Unanswered,
    Unavailable,
    Conflict,
    CutOff,
}

impl S3Double {
    pub fn start(behaviour: StoreBehaviour) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
        let endpoint = format!("http://{}", listener.local_addr().expect("its address"));
        let seed = if let StoreBehaviour::Unreliable(seed) = behaviour { seed } else { 0 };
        let state = Arc::new(Mutex::new(StoreState {
            objects: BTreeMap::new(),
            uploads: BTreeMap::new(),
            behaviour,
            random: ChaCha8Rng::seed_from_u64(seed),
            faults: 0,
            requests: 0,
            log: Vec::new(),
            connections: 0,
            parts: 0,
            part_limit: usize::MAX,
        }));
        let shared = state.clone();
        std::thread::spawn(move || {
            for client in listener.incoming().flatten() {
                let state = shared.clone();
                state.lock().expect("no panic").connections += 1;
                // A client that hangs up, and a fault that ends its connection, end this thread.
                std::thread::spawn(move || {
                    drop(answer_client(client, &state));
                    state.lock().expect("no panic").connections -= 1;
                });
            }
        });
        Self { endpoint, state }
    }

    /// Variables with which a command reaches it.
    pub fn environment(&self) -> [(&'static str, String); 5] {
        [
            ("AWS_ENDPOINT_URL", self.endpoint.clone()),
            ("AWS_ALLOW_HTTP", "true".to_owned()),
            ("AWS_ACCESS_KEY_ID", "key".to_owned()),
            ("AWS_SECRET_ACCESS_KEY", "secret".to_owned()),
            ("AWS_REGION", "us-east-1".to_owned()),
        ]
    }

    fn state(&self) -> MutexGuard<'_, StoreState> {
        self.state.lock().expect("no panic")
    }

    pub fn put(&self, key: &str, bytes: Vec<u8>) {
        self.state().put(key, bytes);
    }

    pub fn set_behaviour(&self, behaviour: StoreBehaviour) {
        self.state().behaviour = behaviour;
    }

    pub fn keys(&self) -> Vec<String> {
        self.state().objects.keys().cloned().collect()
    }

    /// The requests since the last call: method and key.
    pub fn take_requests(&self) -> Vec<String> {
        std::mem::take(&mut self.state().log)
    }

    pub fn get(&self, key: &str) -> Vec<u8> {
        let state = self.state();
        state.objects.get(key).unwrap_or_else(|| panic!("no `{key}` in {:?}", state.objects.keys())).bytes.clone()
    }

    /// Loses all parts behind so many.
    pub fn limit_parts(&self, limit: usize) {
        self.state().part_limit = limit;
    }

    /// Number of open connections.
    pub fn connections(&self) -> usize {
        self.state().connections
    }

    /// Number of parts that were stored.
    pub fn parts(&self) -> usize {
        self.state().parts
    }

    /// Forgets all uploads that are not complete, as a bucket's rule does after a day.
    pub fn abort_uploads(&self) {
        self.state().uploads.clear();
    }

    /// Requests, and faults among them.
    pub fn counts(&self) -> (usize, usize) {
        let state = self.state();
        (state.requests, state.faults)
    }
}

fn answer_client(client: TcpStream, state: &Mutex<StoreState>) -> io::Result<()> {
    client.set_nodelay(true)?;
    let mut reader = BufReader::new(client.try_clone()?);
    let mut writer = client;
    while let Some(request) = read_request(&mut reader)? {
        let (fault, answer) = {
            let mut state = state.lock().expect("no panic");
            let fault = state.draw_fault(&request);
            let answer = match fault {
                RequestFault::Unavailable => refusal("503 Service Unavailable", "SlowDown"),
                RequestFault::Conflict => refusal("409 Conflict", "ConditionalRequestConflict"),
                RequestFault::Lost => refusal("503 Service Unavailable", "SlowDown"),
                RequestFault::None | RequestFault::Unanswered | RequestFault::CutOff => state.answer(&request),
            };
            (fault, answer)
        };
        if matches!(fault, RequestFault::Unanswered | RequestFault::Lost) {
            return Ok(());
        }
        let HttpAnswer { status, headers, body } = answer;
        let head = format!("HTTP/1.1 {status}\r\nContent-Length: {}\r\n{headers}\r\n", body.len());
        writer.write_all(head.as_bytes())?;
        if fault == RequestFault::CutOff {
            return writer.write_all(&body[..body.len() / CUT_AT]);
        }
        if request.method != "HEAD" {
            writer.write_all(&body)?;
        }
    }
    Ok(())
}

fn read_request(reader: &mut BufReader<TcpStream>) -> io::Result<Option<HttpRequest>> {
    let mut line = String::new();
    if reader.read_line(&mut line)? == 0 {
        return Ok(None);
    }
    let mut words = line.split_whitespace();
    let (method, target) = (words.next().unwrap_or_default().to_owned(), words.next().unwrap_or_default());
    let (path, query) = target.split_once('?').unwrap_or((target, ""));
    let key = path.trim_start_matches('/').split_once('/').map(|(_, key)| decode(key)).unwrap_or_default();
    let pair = |text: &str| {
        let (name, value) = text.split_once('=').unwrap_or((text, ""));
        (decode(name), decode(value))
    };
    let query = query.split('&').filter(|text| !text.is_empty()).map(pair).collect();
    let mut headers = BTreeMap::new();
    loop {
        let mut line = String::new();
        reader.read_line(&mut line)?;
        let Some((name, value)) = line.trim_end().split_once(':') else { break };
        headers.insert(name.to_ascii_lowercase(), value.trim().to_owned());
    }
    let length = headers.get("content-length").and_then(|text| text.parse().ok()).unwrap_or(0);
    let mut body = vec![0; length];
    reader.read_exact(&mut body)?;
    Ok(Some(HttpRequest { method, key, query, headers, body }))
}

fn decode(text: &str) -> String {
    let (mut bytes, mut rest) = (Vec::new(), text.as_bytes());
    while let [first, behind @ ..] = rest {
        let code = behind.get(..2).and_then(|hex| u8::from_str_radix(std::str::from_utf8(hex).ok()?, 16).ok());
        match (first, code) {
            (b'%', Some(code)) => {
                bytes.push(code);
                rest = &behind[2..];
            }
            (other, _) => {
                bytes.push(*other);
                rest = behind;
            }
        }
    }
    String::from_utf8(bytes).expect("UTF-8")
}

fn ok(headers: String, body: Vec<u8>) -> HttpAnswer {
    HttpAnswer { status: "200 OK", headers, body }
}

fn xml(text: String) -> HttpAnswer {
    ok("Content-Type: application/xml\r\n".to_owned(), format!("<?xml version=\"1.0\"?>{text}").into_bytes())
}

fn refusal(status: &'static str, code: &str) -> HttpAnswer {
    let body = format!("<?xml version=\"1.0\"?><Error><Code>{code}</Code><Message>as asked for</Message></Error>");
    HttpAnswer { status, headers: String::new(), body: body.into_bytes() }
}

fn e_tag(bytes: &[u8]) -> String {
    format!("{:08x}", bytes.iter().fold(0_u32, |sum, b| sum.wrapping_mul(31).wrapping_add(u32::from(*b))))
}

fn tag_header(e_tag: &str) -> String {
    format!("ETag: \"{e_tag}\"\r\n")
}

impl StoreState {
    fn draw_fault(&mut self, request: &HttpRequest) -> RequestFault {
        self.requests += 1;
        self.log.push(format!("{} {}", request.method, request.key));
        if request.query.contains_key("partNumber") && self.parts >= self.part_limit {
            return RequestFault::Lost;
        }
        if !matches!(self.behaviour, StoreBehaviour::Unreliable(_)) {
            return RequestFault::None;
        }
        let drawn = self.random.random_range(0..20);
        let creates = request.method == "PUT" && request.headers.contains_key("if-none-match");
        let fault = match (request.method.as_str(), drawn) {
            ("PUT", 0..4) if creates => RequestFault::Unanswered,
            ("PUT", 4 | 5) if creates => RequestFault::Unavailable,
            ("PUT", 6 | 7) if creates => RequestFault::Conflict,
            ("GET", 0 | 1) if request.query.contains_key("list-type") => RequestFault::CutOff,
            ("GET", 0) => RequestFault::Unavailable,
            _ => RequestFault::None,
        };
        self.faults += usize::from(fault != RequestFault::None);
        fault
    }

    fn answer(&mut self, request: &HttpRequest) -> HttpAnswer {
        let key = request.key.as_str();
        let has = |name: &str| request.query.contains_key(name);
        match request.method.as_str() {
            "GET" if has("list-type") => self.list(request),
            "GET" | "HEAD" => self.read(request),
            "PUT" if has("partNumber") => {
                let number = request.query["partNumber"].parse().expect("a number");
                let Some(upload) = self.uploads.get_mut(&request.query["uploadId"]) else {
                    return refusal("404 Not Found", "NoSuchUpload");
                };
                upload.insert(number, request.body.clone());
                self.parts += 1;
                ok(tag_header(&e_tag(&request.body)), Vec::new())
            }
            "PUT" if request.headers.contains_key("x-amz-copy-source") => {
                let source = decode(&request.headers["x-amz-copy-source"]);
                let source = source.trim_start_matches('/').split_once('/').expect("bucket and key").1;
                let Some(found) = self.objects.get(source).cloned() else {
                    return refusal("404 Not Found", "NoSuchKey");
                };
                let mut bytes = found.bytes;
                if self.behaviour == StoreBehaviour::DamagesCopies && found.e_tag.contains('-') {
                    let middle = bytes.len() / 2;
                    bytes[middle] ^= 1;
                }
                self.put(key, bytes);
                xml("<CopyObjectResult><ETag>x</ETag></CopyObjectResult>".to_owned())
            }
            "PUT" => {
                let creates = request.headers.contains_key("if-none-match");
                let overwrites = self.behaviour == StoreBehaviour::Overwrites;
                if creates && !overwrites && self.objects.contains_key(key) {
                    return refusal("412 Precondition Failed", "PreconditionFailed");
                }
                self.put(key, request.body.clone());
                ok(tag_header(&e_tag(&request.body)), Vec::new())
            }
            "POST" if has("uploads") => {
                let id = format!("upload-{}", self.requests);
                self.uploads.insert(id.clone(), BTreeMap::new());
                xml(format!("<InitiateMultipartUploadResult><UploadId>{id}</UploadId></InitiateMultipartUploadResult>"))
            }
            "POST" if has("delete") => self.delete_many(&request.body),
            "POST" => {
                let Some(parts) = self.uploads.remove(&request.query["uploadId"]) else {
                    return refusal("404 Not Found", "NoSuchUpload");
                };
                let count = parts.len();
                self.put(key, parts.into_values().flatten().collect());
                if let Some(object) = self.objects.get_mut(key) {
                    object.e_tag = format!("{}-{count}", object.e_tag);
                }
                let tag = "<ETag>\"x\"</ETag>";
                xml(format!("<CompleteMultipartUploadResult>{tag}</CompleteMultipartUploadResult>"))
            }
            _ => {
                self.objects.remove(key);
                HttpAnswer { status: "204 No Content", headers: String::new(), body: Vec::new() }
            }
        }
    }

    fn put(&mut self, key: &str, bytes: Vec<u8>) {
        let e_tag = e_tag(&bytes);
        self.objects.insert(key.to_owned(), StoredObject { bytes, e_tag, modified: Utc::now() });
    }

    fn delete_many(&mut self, body: &[u8]) -> HttpAnswer {
        let text = String::from_utf8_lossy(body);
        let mut deleted = String::new();
        for part in text.split("<Key>").skip(1) {
            let key = part.split("</Key>").next().unwrap_or_default();
            self.objects.remove(key);
            write!(deleted, "<Deleted><Key>{key}</Key></Deleted>").expect("text");
        }
        xml(format!("<DeleteResult>{deleted}</DeleteResult>"))
    }

    fn read(&self, request: &HttpRequest) -> HttpAnswer {
        let Some(object) = self.objects.get(&request.key) else { return refusal("404 Not Found", "NoSuchKey") };
        let (bytes, length) = (&object.bytes, object.bytes.len());
        let modified = object.modified.format("%a, %d %b %Y %H:%M:%S GMT");
        let headers = format!("{}Last-Modified: {modified}\r\n", tag_header(&object.e_tag));
        let Some(range) = request.headers.get("range").and_then(|text| text.strip_prefix("bytes=")) else {
            return ok(headers, bytes.clone());
        };
        let (first, last) = range.split_once('-').expect("a range");
        let (first, end) = match (first.parse::<usize>(), last.parse::<usize>()) {
            (Ok(first), Ok(last)) => (first, (last + 1).min(length)),
            (Ok(first), Err(_)) => (first, length),
            (Err(_), suffix) => (length.saturating_sub(suffix.expect("a length")), length),
        };
        if first >= length {
            return refusal("416 Range Not Satisfiable", "InvalidRange");
        }
        let headers = format!("{headers}Content-Range: bytes {first}-{}/{length}\r\n", end - 1);
        HttpAnswer { status: "206 Partial Content", headers, body: bytes[first..end].to_vec() }
    }

    fn list(&self, request: &HttpRequest) -> HttpAnswer {
        let prefix = request.query.get("prefix").map(String::as_str).unwrap_or_default();
        let (mut contents, mut folders) = (String::new(), BTreeSet::new());
        for (key, object) in self.objects.iter().filter(|(key, _)| key.starts_with(prefix)) {
            let behind = &key[prefix.len()..];
            if let Some((folder, _)) = behind.split_once('/').filter(|_| request.query.contains_key("delimiter")) {
                folders.insert(format!("{prefix}{folder}/"));
                continue;
            }
            let (modified, size) = (object.modified.format("%Y-%m-%dT%H:%M:%S.000Z"), object.bytes.len());
            let entry = format!("<Key>{key}</Key><LastModified>{modified}</LastModified><Size>{size}</Size>");
            write!(contents, "<Contents>{entry}</Contents>").expect("text");
        }
        for folder in folders {
            write!(contents, "<CommonPrefixes><Prefix>{folder}</Prefix></CommonPrefixes>").expect("text");
        }
        xml(format!("<ListBucketResult><IsTruncated>false</IsTruncated>{contents}</ListBucketResult>"))
    }
}

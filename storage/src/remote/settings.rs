//! Settings of object stores, from the environment.

use std::path::PathBuf;
use std::sync::Arc;

use echolake_schema::ErrorCause;
use object_store::aws::{AmazonS3Builder, AmazonS3ConfigKey};
use object_store::azure::{AzureConfigKey, MicrosoftAzureBuilder};
use object_store::gcp::{GoogleCloudStorageBuilder, GoogleConfigKey};
use object_store::multipart::MultipartStore;
use object_store::{ClientConfigKey, ObjectStore, RetryConfig};
use url::Url;

use super::store_threads::store_connector;
use crate::location_text::without_secrets;

/// Time for one request with its body: a part of an upload over a slow line takes long.
const REQUEST_TIMEOUT: &str = "120 seconds";
/// Variable with the number of tries of a request, as AWS's own tools have it.
const MAX_ATTEMPTS: &str = "AWS_MAX_ATTEMPTS";
/// Ports of HTTPS, of the services that tell a machine its credentials, and of names of machines if answers are long.
const ALWAYS: [u16; 3] = [443, 80, 53];

/// What a process needs of its machine to reach an object store.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct RemoteAccess {
    /// TCP ports that it connects to.
    pub ports: Vec<u16>,
    /// Files and folders that it reads: names of machines, certificates, a token.
    pub files: Vec<PathBuf>,
}

/// Returns what a process needs to reach the store of a location, by this process's environment; None if the location
/// is on this machine.
pub fn remote_access(location: &str) -> Option<RemoteAccess> {
    let url = Url::parse(location).ok().filter(|url| matches!(url.scheme(), "s3" | "gs" | "az"))?;
    let endpoints = match url.scheme() {
        "s3" => ["AWS_ENDPOINT", "AWS_ENDPOINT_URL", "AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT_URL_STS"].as_slice(),
        "gs" => &["GOOGLE_BASE_URL"],
        _ => &["AZURE_STORAGE_ENDPOINT", "AZURE_ENDPOINT"],
    };
    let urls =
        endpoints.iter().chain(&["HTTPS_PROXY", "https_proxy", "HTTP_PROXY", "http_proxy"]).filter_map(read_variable);
    let urls = urls.chain(read_variable(&"AWS_CONTAINER_CREDENTIALS_FULL_URI"));
    let mut ports: Vec<_> = urls.filter_map(|url| Url::parse(&url).ok()?.port_or_known_default()).collect();
    ports.extend(ALWAYS);
    ports.sort_unstable();
    ports.dedup();
    let named = [
        "SSL_CERT_FILE",
        "SSL_CERT_DIR",
        "AWS_WEB_IDENTITY_TOKEN_FILE",
        "AWS_CONTAINER_AUTHORIZATION_TOKEN_FILE",
        "GOOGLE_SERVICE_ACCOUNT",
        "GOOGLE_SERVICE_ACCOUNT_PATH",
        "GOOGLE_APPLICATION_CREDENTIALS",
        "AZURE_FEDERATED_TOKEN_FILE",
    ];
    let system = [
        "/etc/resolv.conf",
        "/etc/hosts",
        "/etc/nsswitch.conf",
        "/etc/host.conf",
        "/etc/gai.conf",
        "/etc/services",
        "/run/systemd/resolve",
        "/etc/ssl",
        "/etc/pki",
        "/etc/ca-certificates",
        "/usr/share/ca-certificates",
        "/usr/local/share/ca-certificates",
        "/lib",
        "/lib64",
        "/usr/lib",
        "/etc/ld.so.cache",
    ];
    let files = system.iter().map(PathBuf::from).chain(named.iter().filter_map(read_variable).map(PathBuf::from));
    Some(RemoteAccess { ports, files: files.collect() })
}

/// A bucket, by both of its interfaces.
pub(super) type BucketStore = (Arc<dyn ObjectStore>, Arc<dyn MultipartStore>);

/// The store of a bucket.
pub(super) fn build_store(scheme: &str, bucket: &str) -> Result<BucketStore, ErrorCause> {
    let timeout = REQUEST_TIMEOUT;
    let key = ClientConfigKey::Timeout;
    Ok(match scheme {
        "s3" => {
            let builder = AmazonS3Builder::from_env()
                .with_bucket_name(bucket)
                .with_retry(retry_config()?)
                .with_http_connector(store_connector()?);
            let endpoint = [AmazonS3ConfigKey::S3Endpoint, AmazonS3ConfigKey::Endpoint];
            let endpoint = endpoint.iter().find_map(|key| builder.get_config_value(key));
            let allows_http = builder.get_config_value(&AmazonS3ConfigKey::Client(ClientConfigKey::AllowHttp));
            if let Some(endpoint) = endpoint.filter(|endpoint| endpoint.starts_with("http://"))
                && allows_http.is_none_or(|allowed| allowed != "true")
            {
                return Err(format!(
                    "the endpoint `{}` is not encrypted; hint: set AWS_ALLOW_HTTP=true if that is meant",
                    without_secrets(&endpoint)
                )
                .into());
            }
            bucket_store(builder.with_config(AmazonS3ConfigKey::Client(key), timeout).build()?)
        }
        "gs" => {
            let builder = GoogleCloudStorageBuilder::from_env()
                .with_bucket_name(bucket)
                .with_retry(retry_config()?)
                .with_http_connector(store_connector()?);
            bucket_store(builder.with_config(GoogleConfigKey::Client(key), timeout).build()?)
        }
        "az" => {
            let builder = MicrosoftAzureBuilder::from_env()
                .with_container_name(bucket)
                .with_retry(retry_config()?)
                .with_http_connector(store_connector()?);
            bucket_store(builder.with_config(AzureConfigKey::Client(key), timeout).build()?)
        }
        scheme => return Err(format!("this build does not reach `{scheme}://`").into()),
    })
}

fn bucket_store<S: ObjectStore + MultipartStore>(store: S) -> BucketStore {
    let store = Arc::new(store);
    (store.clone(), store)
}

/// Returns how often a request is tried, if the environment says it.
///
/// # Errors
/// If what it says is no number.
pub(super) fn max_attempts() -> Result<Option<u32>, ErrorCause> {
    let Some(text) = read_variable(&MAX_ATTEMPTS) else { return Ok(None) };
    Ok(Some(text.parse().map_err(|_| format!("{MAX_ATTEMPTS} is `{text}`, expected a number"))?))
}

fn retry_config() -> Result<RetryConfig, ErrorCause> {
    let Some(attempts) = max_attempts()? else { return Ok(RetryConfig::default()) };
    Ok(RetryConfig { max_retries: attempts.saturating_sub(1) as usize, ..RetryConfig::default() })
}

fn read_variable(name: &&str) -> Option<String> {
    std::env::var(name).ok().filter(|text| !text.is_empty())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lake_on_this_machine_needs_no_network() {
        for local in ["lake", "/data/lake", "file:///data/lake", "memory://"] {
            assert_eq!(remote_access(local), None, "{local}");
        }
        let access = remote_access("s3://bucket/lake").expect("remote");
        assert!(access.ports.contains(&443) && access.files.contains(&PathBuf::from("/etc/resolv.conf")));
    }
}

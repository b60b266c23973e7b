//! Posts a notice to a URL if a run breaks off, for people who are not beside the rig.

use std::time::Duration;

use clap::Args;
use reqwest::Url;
use serde_json::Value;

use crate::error_text::describe_error;

/// Maximum time of a notice: it holds up the end of a command.
const TIMEOUT: Duration = Duration::from_secs(10);

#[derive(Debug, Args)]
pub(crate) struct NotifyArgs {
    /// Post a JSON object with `event`, `surface` or `campaign`, `error` and more to this http or https URL if the run
    /// breaks off.
    #[arg(long, value_name = "URL", value_parser = parse_url)]
    notify: Option<Url>,
}

impl NotifyArgs {
    /// Posts a notice if a URL is named. If it cannot be sent, this is a warning.
    pub async fn post_notice(&self, notice: &Value) {
        let Some(url) = &self.notify else { return };
        if let Err(error) = send_notice(url, notice).await {
            // The rest of the address may be a secret.
            let host = url.host_str().unwrap_or_default();
            eprintln!("warning: the notice was not sent to {host}: {}", describe_error(&error.without_url().into()));
        }
    }
}

async fn send_notice(url: &Url, notice: &Value) -> reqwest::Result<()> {
    let client = reqwest::Client::builder().timeout(TIMEOUT).build()?;
    let request = client.post(url.clone()).header(reqwest::header::CONTENT_TYPE, "application/json");
    request.body(notice.to_string()).send().await?.error_for_status()?;
    Ok(())
}

fn parse_url(text: &str) -> Result<Url, String> {
    let url: Url = text.parse().map_err(|e| format!("{e}; hint: https://host/path"))?;
    match url.scheme() {
        "http" | "https" => Ok(url),
        other => Err(format!("`{other}` is not http or https")),
    }
}

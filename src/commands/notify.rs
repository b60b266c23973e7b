//! Posts a notice to a URL if a run breaks off, for people who are not beside the rig.

use std::time::Duration;

use clap::Args;
use reqwest::Url;
use reqwest::redirect::{Action, Attempt, Policy};
use serde_json::Value;

use crate::error_text::describe_error;

/// Maximum time of a notice: it holds up the end of a command.
const TIMEOUT: Duration = Duration::from_secs(10);
/// Maximum number of redirects that a notice follows.
const MOST_REDIRECTS: usize = 5;

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
    let client = reqwest::Client::builder().timeout(TIMEOUT).redirect(Policy::custom(follow_redirect)).build()?;
    let request = client.post(url.clone()).header(reqwest::header::CONTENT_TYPE, "application/json");
    request.body(notice.to_string()).send().await?.error_for_status()?;
    Ok(())
}

// The notice is for the host that the user named, and so is what its path may have of a secret.
fn follow_redirect(attempt: Attempt<'_>) -> Action {
    let to = attempt.url();
    let is_allowed = |from: &Url| to.host() == from.host() && [from.scheme(), "https"].contains(&to.scheme());
    if attempt.previous().len() <= MOST_REDIRECTS && attempt.previous().last().is_some_and(is_allowed) {
        return attempt.follow();
    }
    let host = to.host_str().unwrap_or_default().to_owned();
    attempt.error(format!("it is redirected to {host}, which is not followed; hint: name the last address"))
}

fn parse_url(text: &str) -> Result<Url, String> {
    let url: Url = text.parse().map_err(|e| format!("{e}; hint: https://host/path"))?;
    match url.scheme() {
        "http" | "https" => Ok(url),
        other => Err(format!("`{other}` is not http or https")),
    }
}

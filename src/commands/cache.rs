//! Arguments of commands that read a lake on an object store through a cache.

use std::path::PathBuf;
use std::str::FromStr;

use echolake_lake::{CacheFolder, Lake};

/// The smallest cache that is worth its folder.
const LEAST_BYTES: u64 = 100_000_000;
/// Units of sizes; a number without one is of bytes.
const UNITS: [(&str, u64); 7] = [
    ("TB", 1_000_000_000_000),
    ("GB", 1_000_000_000),
    ("MB", 1_000_000),
    ("TiB", 1 << 40),
    ("GiB", 1 << 30),
    ("MiB", 1 << 20),
    ("", 1),
];

#[derive(Debug, Clone, clap::Args)]
pub(crate) struct CacheArgs {
    /// Folder that caches what is read of a lake on an object store. Commands and servers may share it.
    #[arg(long, value_name = "DIR")]
    cache: Option<PathBuf>,
    /// Size limit of that folder, for all that share it together.
    #[arg(long, value_name = "SIZE", default_value = "10GB")]
    cache_size: CacheSize,
}

/// A number of bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct CacheSize(u64);

impl FromStr for CacheSize {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let text = text.trim();
        let parse = |(unit, factor): &(&str, u64)| {
            let number: u64 = text.strip_suffix(unit)?.trim_end().parse().ok()?;
            number.checked_mul(*factor)
        };
        let bytes = UNITS.iter().find_map(parse).ok_or("not as 10GB, 500MB or 64GiB")?;
        match bytes >= LEAST_BYTES {
            true => Ok(Self(bytes)),
            false => Err(format!("it is {bytes} bytes, expected 100MB or more")),
        }
    }
}

impl CacheArgs {
    /// The folder, if there is one.
    pub fn cache_folder(&self) -> Option<CacheFolder> {
        Some(CacheFolder { path: self.cache.clone()?, bytes: self.cache_size.0 })
    }

    /// Opens a lake with the cache.
    pub async fn open_lake(&self, url: &str) -> anyhow::Result<Lake> {
        let lake = Lake::open(url).await?;
        if self.cache.is_some() && !lake.is_remote() {
            eprintln!("note: --cache is for lakes on object stores; `{}` is read without", lake.location());
        }
        Ok(lake.with_cache(self.cache_folder().as_ref()).await?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_have_units() {
        for (text, bytes) in [
            ("10GB", 10_000_000_000),
            ("500 MB", 500_000_000),
            ("1TB", 1_000_000_000_000),
            ("1GiB", 1 << 30),
            ("200000000", 200_000_000),
        ] {
            assert_eq!(text.parse(), Ok(CacheSize(bytes)), "{text}");
        }
        for text in ["", "GB", "10", "10MB", "1.5GB", "-1GB", "10 apples", "99999999999TB"] {
            assert!(text.parse::<CacheSize>().is_err(), "{text}");
        }
    }
}

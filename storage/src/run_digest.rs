//! SHA-256 of run files: of files on this machine, of objects, and as it is recorded beside an object.
//!
//! The record of `inbox/RUN.mcap` is `inbox/RUN.mcap.sha256`, a line as `sha256sum` writes it.

use std::fs::File;
use std::io::{self, Read as _};
use std::path::Path as FsPath;

use futures::{StreamExt as _, TryStreamExt as _, stream};
use object_store::path::Path;
use object_store::{Error as StoreError, ObjectStore, ObjectStoreExt as _, Result as StoreResult};
use sha2::{Digest as _, Sha256};

/// Bytes that are read at a time.
const BLOCK: u64 = 8 << 20;
/// Blocks of an object that are fetched at once.
const BLOCKS_AT_ONCE: usize = 3;
/// Extension of a record.
const EXTENSION: &str = "sha256";
/// Largest record that is read.
const LARGEST_RECORD: u64 = 4 << 10;

/// Returns a file's SHA-256 in hex, and its size. `progress` is called with the bytes that are read so far.
///
/// # Errors
/// The system refuses to read it.
pub fn file_sha256(file: &FsPath, progress: &mut dyn FnMut(u64)) -> io::Result<(String, u64)> {
    let mut file = File::open(file)?;
    let mut sha = Sha256::new();
    let mut bytes = 0;
    let mut block = vec![0; 1 << 20];
    loop {
        match file.read(&mut block) {
            Ok(0) => return Ok((hex::encode(sha.finalize()), bytes)),
            Ok(count) => {
                sha.update(&block[..count]);
                bytes += count as u64;
                progress(bytes);
            }
            Err(e) if e.kind() == io::ErrorKind::Interrupted => {}
            Err(e) => return Err(e),
        }
    }
}

/// Returns the SHA-256 in hex of an object of this size. `progress` is called with the bytes that are read so far.
///
/// # Errors
/// What the store says; [`StoreError::NotFound`] if the object is gone.
pub async fn object_sha256(
    store: &dyn ObjectStore,
    path: &Path,
    bytes: u64,
    progress: &mut (dyn FnMut(u64) + Send),
) -> StoreResult<String> {
    let fetch = |number: u64| {
        let begin = number * BLOCK;
        store.get_range(path, begin..(begin + BLOCK).min(bytes))
    };
    let mut blocks = stream::iter(0..bytes.div_ceil(BLOCK)).map(fetch).buffered(BLOCKS_AT_ONCE);
    let mut sha = Sha256::new();
    let mut read = 0;
    while let Some(block) = blocks.try_next().await? {
        sha.update(&block);
        read += block.len() as u64;
        progress(read);
    }
    Ok(hex::encode(sha.finalize()))
}

/// Path of the record of a run file's digest.
pub fn digest_record_path(run_file: &Path) -> Path {
    let text = format!("{run_file}.{EXTENSION}");
    // A path is encoded already; what is added needs no encoding.
    Path::parse(&text).unwrap_or_else(|_| Path::from(text))
}

/// Returns the text of the record of a run file's digest.
pub fn digest_record(sha256: &str, run_file: &Path) -> String {
    format!("{sha256}  {}\n", run_file.filename().unwrap_or_default())
}

/// Returns the digest that is recorded for a run file; None if there is no record.
///
/// # Errors
/// What the store says.
pub async fn read_digest_record(store: &dyn ObjectStore, run_file: &Path) -> StoreResult<Option<String>> {
    let found = match store.get(&digest_record_path(run_file)).await {
        Ok(found) => found,
        Err(StoreError::NotFound { .. }) => return Ok(None),
        Err(e) => return Err(e),
    };
    if found.meta.size > LARGEST_RECORD {
        return Ok(Some(format!("a record of {} bytes", found.meta.size)));
    }
    let text = found.bytes().await?;
    let text = String::from_utf8_lossy(&text);
    Ok(Some(text.split_whitespace().next().unwrap_or("none").to_ascii_lowercase()))
}

#[cfg(test)]
mod tests {
    use object_store::memory::InMemory;

    use super::*;

    // SHA-256 of 20 MB of zeros, as `head -c 20000000 /dev/zero | sha256sum` prints it.
    const TWENTY_MB_OF_ZEROS: &str = "9e21c61969cd3e077a1b2b58ddb583b175e13c6479d2d83912eaddc23c0cdd52";

    #[tokio::test]
    async fn files_and_objects_have_the_digest_that_sha256sum_prints() {
        let folder = tempfile::tempdir().expect("a folder");
        let (file, zeros) = (folder.path().join("zeros"), vec![0; 20_000_000]);
        std::fs::write(&file, &zeros).expect("written");
        let (mut seen, mut last) = (0, 0);
        let of_file = file_sha256(&file, &mut |bytes| seen = bytes).expect("read");
        assert_eq!((of_file, seen), ((TWENTY_MB_OF_ZEROS.to_owned(), 20_000_000), 20_000_000));
        let (store, path) = (InMemory::new(), Path::from("inbox/r.mcap"));
        store.put(&path, zeros.into()).await.expect("written");
        let of_object = object_sha256(&store, &path, 20_000_000, &mut |bytes| last = bytes).await.expect("read");
        assert_eq!((of_object.as_str(), last), (TWENTY_MB_OF_ZEROS, 20_000_000));
    }

    #[tokio::test]
    async fn a_record_is_read_as_it_was_written_and_may_be_absent_or_strange() {
        let (store, run) = (InMemory::new(), Path::from("inbox/r.mcap"));
        assert_eq!(read_digest_record(&store, &run).await.expect("read"), None);
        let path = digest_record_path(&run);
        assert_eq!(path.as_ref(), "inbox/r.mcap.sha256");
        for (text, expected) in [
            (digest_record("ab12", &run), "ab12"),
            ("AB12 *elsewhere.mcap".to_owned(), "ab12"),
            (String::new(), "none"),
            ("x".repeat(5000), "a record of 5000 bytes"),
        ] {
            store.put(&path, text.clone().into()).await.expect("written");
            assert_eq!(read_digest_record(&store, &run).await.expect("read").as_deref(), Some(expected), "{text}");
        }
    }
}

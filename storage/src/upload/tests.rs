//! Uploads to a lake in a folder, cut off at any byte, and names that are taken.

use std::fs;

use echolake_schema::Rig;

use super::*;
use crate::ReferenceSurfaces;
use crate::run_digest::file_sha256;

struct TestUpload {
    folder: tempfile::TempDir,
    lake: Lake,
    run: RunUpload,
}

impl TestUpload {
    async fn new(content: &[u8]) -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        let url = folder.path().join("lake").display().to_string();
        let lake = Lake::open_or_create(&url, &Rig::paper(), &ReferenceSurfaces::default()).await.expect("a lake");
        let run = Self::run(&folder, "r.mcap", content);
        Self { folder, lake, run }
    }

    fn run(folder: &tempfile::TempDir, name: &str, content: &[u8]) -> RunUpload {
        let file = folder.path().join(name);
        fs::write(&file, content).expect("written");
        let (sha256, bytes) = file_sha256(&file, &mut |_| {}).expect("read");
        let (surface, run) = ("flat".parse().expect("an id"), "r".parse().expect("an id"));
        RunUpload { file, surface, run, bytes, sha256 }
    }

    async fn upload(&self, run: &RunUpload) -> Result<UploadOutcome> {
        self.lake.upload_run(run, &mut |_, _| {}).await
    }

    fn in_lake(&self, name: &str) -> PathBuf {
        self.folder.path().join("lake").join(name)
    }
}

fn inbox() -> Path {
    Path::from("inbox/r.mcap")
}

fn content() -> Vec<u8> {
    (0..20_000_000_u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect()
}

#[tokio::test]
async fn what_is_there_of_a_file_is_not_copied_again() {
    let test = TestUpload::new(&content()).await;
    fs::create_dir_all(test.in_lake("inbox")).expect("made");
    let staged = test.in_lake("inbox/r.mcap.uploading");
    fs::write(&staged, &content()[..12_345_678]).expect("written");
    let mut first = None;
    let mut progress = |step, bytes| {
        if step == UploadStep::Send {
            first.get_or_insert(bytes);
        }
    };
    let outcome = test.lake.upload_run(&test.run, &mut progress).await.expect("uploaded");
    assert_eq!((outcome, first), (UploadOutcome::Uploaded(inbox()), Some(12_345_678)));
    assert!(fs::read(test.in_lake("inbox/r.mcap")).expect("there") == content() && !staged.exists());
    let record = fs::read_to_string(test.in_lake("inbox/r.mcap.sha256")).expect("there");
    assert_eq!(record, format!("{}  r.mcap\n", test.run.sha256));
    assert_eq!(test.upload(&test.run).await.expect("there"), UploadOutcome::Present(inbox()));
}

#[tokio::test]
async fn what_is_not_the_beginning_of_the_file_is_deleted_and_copied_anew() {
    let test = TestUpload::new(&content()).await;
    fs::create_dir_all(test.in_lake("inbox")).expect("made");
    let staged = test.in_lake("inbox/r.mcap.uploading");
    fs::write(&staged, [0; 1000]).expect("written");
    let error = test.upload(&test.run).await.expect_err("damaged").to_string();
    assert!(error.contains(&test.run.sha256) && error.contains("hint: "), "{error}");
    assert!(!staged.exists() && !test.in_lake("inbox/r.mcap").exists());
    assert_eq!(test.upload(&test.run).await.expect("uploaded"), UploadOutcome::Uploaded(inbox()));
}

#[tokio::test]
async fn another_file_of_the_name_is_refused_wherever_it_is() {
    let test = TestUpload::new(b"one").await;
    let longer = TestUpload::run(&test.folder, "longer.mcap", b"two of it");
    let other = TestUpload::run(&test.folder, "other.mcap", b"two");
    let refuse = async |expected: &str| {
        for run in [&longer, &other] {
            let error = test.upload(run).await.expect_err("taken");
            assert!(matches!(error, Error::OtherUpload { .. }), "{error}");
            assert!(error.to_string().contains(expected), "{error}");
        }
    };
    // An upload that was begun.
    test.lake.reserve_name(&test.run, &inbox()).await.expect("free");
    refuse(&format!("SHA-256 {}", test.run.sha256)).await;
    test.upload(&test.run).await.expect("uploaded");
    refuse("inbox/r.mcap").await;
    // Without a record, as other programs leave it.
    fs::remove_file(test.in_lake("inbox/r.mcap.sha256")).expect("deleted");
    refuse("inbox/r.mcap").await;
    assert_eq!(test.upload(&test.run).await.expect("there"), UploadOutcome::Present(inbox()));
    // An ingest takes it.
    fs::create_dir_all(test.in_lake("runs/flat")).expect("made");
    fs::rename(test.in_lake("inbox/r.mcap"), test.in_lake("runs/flat/r.mcap")).expect("moved");
    refuse("runs/flat/r.mcap").await;
    let there = UploadOutcome::Present(Path::from("runs/flat/r.mcap"));
    assert_eq!(test.upload(&test.run).await.expect("there"), there);
}

//! Three hundred attempts to bypass the gate: none reads, writes or changes anything.

use echolake_lake::{Lake, ReferenceSurfaces};
use echolake_schema::Rig;

use super::attempts::{SECRET, attempts, files};
use super::*;

async fn answered(session: &Session, sql: &str) -> Result<String, Error> {
    let mut answer = session.query(sql).await?;
    let mut text = String::new();
    while let Some(batch) = answer.next().await? {
        text.push_str(&format!("{batch:?}"));
    }
    Ok(text)
}

#[tokio::test]
async fn no_attempt_has_an_effect() {
    let folder = tempfile::tempdir().expect("a folder");
    let (secret, outside) = (folder.path().join("secret.csv"), folder.path().join("outside"));
    std::fs::write(&secret, format!("a,b\n{SECRET},1\n")).expect("written");
    std::fs::create_dir(&outside).expect("made");
    let url = folder.path().join("lake").display().to_string();
    let lake = Lake::open_or_create(&url, &Rig::paper(), &ReferenceSurfaces::default()).await.expect("a lake");
    let before = files(folder.path());
    let session = Session::new(&lake).expect("a session");
    let all = attempts(&secret, &outside);
    for attempt in &all {
        match answered(&session, attempt).await {
            Ok(text) => assert!(!text.contains(SECRET), "{attempt}: {text}"),
            Err(e) => {
                let said = e.to_string();
                assert!(!said.contains(SECRET) && !said.contains("defect"), "{attempt}: {said}");
            }
        }
    }
    assert_eq!(files(folder.path()), before, "no file is written, changed or deleted");
    assert_eq!(
        answered(&session, "select count(*) n from pairs").await.expect("it still answers").matches("2951").count(),
        1
    );
}

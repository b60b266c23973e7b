//! A probe of a store: of several that create one object, exactly one must succeed. All commits rest on it.

use std::sync::Arc;

use futures::future::{join, join_all};
use object_store::path::Path;
use object_store::{Error as StoreError, ObjectStore, ObjectStoreExt as _, PutMode, PutPayload, Result as StoreResult};
use uuid::Uuid;

/// Folder of the probe's objects, which are deleted at once.
const FOLDER: &str = "tables/_probe";
/// Creations that race for one object.
const RACERS: usize = 8;

/// A store that is not fit for a lake, or cannot be probed.
#[derive(Debug, thiserror::Error)]
pub(crate) enum ExclusionFault {
    /// It lets two create the same object.
    #[error("{0}")]
    Overwrites(String),
    /// The probe has no result.
    #[error(transparent)]
    Store(#[from] StoreError),
}

/// Probes a store by a handful of small objects.
///
/// # Errors
/// [`ExclusionFault`].
pub(crate) async fn probe_exclusion(store: &Arc<dyn ObjectStore>) -> Result<(), ExclusionFault> {
    let path = |name: &str| Path::from(format!("{FOLDER}/{}.{name}", Uuid::new_v4().simple()));
    let twice = path("twice");
    let race = path("race");
    let (repeated, raced) = join(create_twice(store.as_ref(), &twice), race_for(store.as_ref(), &race)).await;
    // An object that stays does no harm.
    let _ = join(store.delete(&twice), store.delete(&race)).await;
    repeated.and(raced)
}

async fn create_twice(store: &dyn ObjectStore, path: &Path) -> Result<(), ExclusionFault> {
    let created =
        (create_object(store, path, "first".into()).await?, create_object(store, path, "second".into()).await?);
    match created {
        (true, false) => Ok(()),
        _ => Err(ExclusionFault::Overwrites("an object that was there was created again".to_owned())),
    }
}

async fn race_for(store: &dyn ObjectStore, path: &Path) -> Result<(), ExclusionFault> {
    let texts: Vec<_> = (0..RACERS).map(|racer| format!("racer {racer}")).collect();
    let racers = join_all(texts.iter().map(|text| create_object(store, path, text.clone().into()))).await;
    let created = racers.into_iter().collect::<StoreResult<Vec<_>>>()?;
    let winners: Vec<_> = (0..RACERS).filter(|racer| created[*racer]).collect();
    let there = store.get(path).await?.bytes().await?;
    match winners[..] {
        [winner] if texts[winner].as_bytes() == there => Ok(()),
        [winner] => {
            let text = format!("the object holds `{}`, its creator wrote `{}`", there.escape_ascii(), texts[winner]);
            Err(ExclusionFault::Overwrites(text))
        }
        _ => {
            let text =
                format!("{} of {RACERS} that created the same object at once succeeded, expected 1", winners.len());
            Err(ExclusionFault::Overwrites(text))
        }
    }
}

/// Creates an object; returns false if it is there already.
///
/// # Errors
/// What the store says.
pub(crate) async fn create_object(store: &dyn ObjectStore, path: &Path, content: PutPayload) -> StoreResult<bool> {
    match store.put_opts(path, content, PutMode::Create.into()).await {
        Ok(_) => Ok(true),
        Err(StoreError::AlreadyExists { .. }) => Ok(false),
        Err(error) => Err(error),
    }
}

//! Cache of answers: each is computed once for all concurrent requests, and the oldest are evicted first.

use std::collections::{HashMap, VecDeque};
use std::future::Future;
use std::sync::{Arc, Mutex, PoisonError};

use tokio::sync::OnceCell;

use super::content::AnswerContent;
use crate::fault::RequestFault;

/// Bytes of answers that are kept of one snapshot.
const MOST_BYTES: usize = 96 << 20;
/// An answer larger than this is not kept.
const LARGEST: usize = 8 << 20;

/// An address with its parameters, and whether the answer is an Arrow stream.
pub(super) type AnswerKey = (String, bool);

/// Cache of answers of one snapshot.
#[derive(Default)]
pub(super) struct AnswerCache(Mutex<CachedAnswers>);

/// A request that waits for an answer. The last one that is dropped without an answer removes the empty entry.
struct AnswerWaiter<'a> {
    answers: &'a AnswerCache,
    cell: Arc<OnceCell<Arc<AnswerContent>>>,
    key: AnswerKey,
}

impl Drop for AnswerWaiter<'_> {
    fn drop(&mut self) {
        let mut kept = self.answers.kept();
        // Two: the map's and this one.
        if !self.cell.initialized() && Arc::strong_count(&self.cell) <= 2 {
            kept.answers.remove(&self.key);
        }
    }
}

#[derive(Default)]
struct CachedAnswers {
    answers: HashMap<AnswerKey, Arc<OnceCell<Arc<AnswerContent>>>>,
    order: VecDeque<(AnswerKey, usize)>,
    bytes: usize,
}

impl AnswerCache {
    /// Returns the answer for a key; `make` runs if it is neither cached nor being made by another request.
    ///
    /// # Errors
    /// Errors of `make`, which are not cached.
    pub(super) async fn once(
        &self,
        key: AnswerKey,
        make: impl Future<Output = Result<AnswerContent, RequestFault>>,
    ) -> Result<Arc<AnswerContent>, RequestFault> {
        let place =
            AnswerWaiter { answers: self, cell: self.kept().answers.entry(key.clone()).or_default().clone(), key };
        let mut made = false;
        let answer = place
            .cell
            .get_or_try_init(|| async {
                let content = make.await?;
                made = true;
                Ok(Arc::new(content))
            })
            .await
            .cloned();
        if let (true, Ok(content)) = (made, &answer) {
            self.keep(place.key.clone(), content);
        }
        answer
    }

    fn keep(&self, key: AnswerKey, content: &AnswerContent) {
        // What it will weigh once it is packed too.
        let weight = content.weight() * 3 / 2 + key.0.len() * 2;
        let mut kept = self.kept();
        if weight > LARGEST {
            kept.answers.remove(&key);
            return;
        }
        kept.bytes += weight;
        kept.order.push_back((key, weight));
        while kept.bytes > MOST_BYTES
            && let Some((oldest, weight)) = kept.order.pop_front()
        {
            kept.bytes -= weight;
            kept.answers.remove(&oldest);
        }
    }

    fn kept(&self) -> std::sync::MutexGuard<'_, CachedAnswers> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};

    use super::*;

    fn key(name: &str) -> AnswerKey {
        (name.to_owned(), false)
    }

    #[tokio::test]
    async fn an_answer_is_made_once_and_a_failure_again() {
        let (answers, made) = (AnswerCache::default(), AtomicUsize::new(0));
        let make = || async {
            made.fetch_add(1, Ordering::Relaxed);
            tokio::task::yield_now().await;
            Ok(AnswerContent::new("text/plain", "x"))
        };
        let (a, b) = tokio::join!(answers.once(key("a"), make()), answers.once(key("a"), make()));
        assert!(Arc::ptr_eq(&a.expect("made"), &b.expect("the same")));
        assert_eq!(made.load(Ordering::Relaxed), 1);
        let failed = answers.once(key("b"), async { Err(RequestFault::Internal) }).await;
        assert!(failed.is_err());
        drop(Box::pin(answers.once(key("c"), make())));
        assert_eq!(answers.kept().answers.len(), 1);
        assert!(answers.once(key("b"), make()).await.is_ok());
    }

    #[tokio::test]
    async fn what_is_kept_is_bounded() {
        let answers = AnswerCache::default();
        for i in 0..60 {
            let large = async { Ok(AnswerContent::new("text/plain", vec![0; LARGEST / 2])) };
            assert!(answers.once(key(&i.to_string()), large).await.is_ok());
            assert!(answers.kept().bytes <= MOST_BYTES);
        }
        let too_large = async { Ok(AnswerContent::new("text/plain", vec![0; LARGEST + 1])) };
        assert!(answers.once(key("too large"), too_large).await.is_ok());
        let kept = answers.kept();
        assert_eq!(kept.answers.len(), kept.order.len());
        assert!(!kept.answers.contains_key(&key("0")) && kept.answers.contains_key(&key("59")));
    }
}

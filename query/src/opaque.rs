//! A shared value that the compiler does not look into.

use std::ops::Deref;
use std::sync::Arc;

/// A shared value behind a trait object, so that it is known to be `Send` and `Sync` without a proof.
///
/// DataFusion's plans and sqlparser's statements are recursive types of hundreds of parts. Every method of an
/// `async_trait` proves anew that what it reaches is `Send`, which took three seconds of compilation for each of
/// thirty methods of the server as long as it reached one of those types.
pub struct Opaque<T: ?Sized>(Arc<dyn Deref<Target = T> + Send + Sync>);

impl<T: Send + Sync + 'static> Opaque<T> {
    /// Shares a value.
    pub fn new(value: T) -> Self {
        Self(Arc::new(Box::new(value)))
    }
}

impl<T: ?Sized> Clone for Opaque<T> {
    fn clone(&self) -> Self {
        Self(self.0.clone())
    }
}

impl<T: ?Sized> Deref for Opaque<T> {
    type Target = T;

    fn deref(&self) -> &T {
        &self.0
    }
}

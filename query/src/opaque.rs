//! A shared value that hides its type from the compiler's auto trait checks.

use std::ops::Deref;
use std::sync::Arc;

/// A shared value behind a trait object, so that the compiler knows it to be `Send` and `Sync` without a proof.
///
/// DataFusion's plans and sqlparser's statements are recursive types of hundreds of parts. Every method of an
/// `async_trait` proves again that all types it reaches are `Send`. For each of thirty methods of the server that
/// reached one of those types, this took three seconds of compilation.
pub struct OpaqueValue<T: ?Sized>(Arc<dyn Deref<Target = T> + Send + Sync>);

impl<T: Send + Sync + 'static> OpaqueValue<T> {
    /// Shares a value.
    pub fn new(value: T) -> Self {
        Self(Arc::new(Box::new(value)))
    }
}

impl<T: ?Sized> OpaqueValue<T> {
    /// Returns whether nobody else shares the value.
    pub(crate) fn is_unshared(&self) -> bool {
        Arc::strong_count(&self.0) == 1
    }
}

impl<T: ?Sized> Clone for OpaqueValue<T> {
    fn clone(&self) -> Self {
        Self(self.0.clone())
    }
}

impl<T: ?Sized> Deref for OpaqueValue<T> {
    type Target = T;

    fn deref(&self) -> &T {
        &self.0
    }
}

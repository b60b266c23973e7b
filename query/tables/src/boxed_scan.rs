//! `TableProvider::scan` without the proofs of `async_trait`.

/// The method `scan` of a `TableProvider`, whose future is an expression of its arguments.
///
/// Written out for the compiler: in an `async fn` of that trait it proves again that expressions are `Sync`, which
/// takes seconds.
#[macro_export]
macro_rules! boxed_scan {
    ($table:ident, $state:ident, $projection:ident, $filters:ident, $limit:ident => $rows:expr) => {
        fn scan<'table, 'state, 'columns, 'filters, 'scan>(
            &'table $table,
            $state: &'state dyn ::datafusion::catalog::Session,
            $projection: Option<&'columns Vec<usize>>,
            $filters: &'filters [::datafusion::logical_expr::Expr],
            $limit: Option<usize>,
        ) -> ::futures::future::BoxFuture<
            'scan,
            ::datafusion::error::Result<::std::sync::Arc<dyn ::datafusion::physical_plan::ExecutionPlan>>,
        >
        where
            'table: 'scan,
            'state: 'scan,
            'columns: 'scan,
            'filters: 'scan,
            Self: 'scan,
        {
            $rows
        }
    };
}

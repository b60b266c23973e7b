//! A session: every query sees one frozen view of the lake and may only read.

use std::sync::Arc;

use arrow::datatypes::{DataType, SchemaRef};
use arrow::record_batch::RecordBatch;
use datafusion::common::ParamValues;
use datafusion::error::DataFusionError;
use datafusion::execution::SendableRecordBatchStream;
use datafusion::execution::context::SQLOptions;
use datafusion::logical_expr::LogicalPlan;
use datafusion::prelude::SessionContext;
use datafusion::sql::parser::Statement;
use echolake_lake::Lake;
use futures::StreamExt as _;

use crate::engine::{Client, Engine, Quota};
use crate::{Error, as_of, gate};

/// Asks a lake in SQL: one a connection.
pub struct Session {
    engine: Engine,
    client: Arc<Client>,
    extend: Option<Extend>,
}

/// Adds a protocol's own tables and functions to the context of every query.
pub type Extend = Arc<dyn Fn(&SessionContext) -> Result<(), DataFusionError> + Send + Sync>;

/// A query that is planned and may be run again and again with other values. It keeps the view of the lake it was
/// planned on.
pub struct Prepared {
    context: SessionContext,
    plan: LogicalPlan,
    sql: String,
}

impl Prepared {
    /// The columns of its answers.
    pub fn schema(&self) -> SchemaRef {
        Arc::new(self.plan.schema().as_arrow().clone())
    }

    /// Types of its placeholders `$1`, `$2`, ... in this order; None where the query does not tell.
    ///
    /// # Errors
    /// [`Error::Query`] where a placeholder is not a number.
    pub fn parameters(&self) -> Result<Vec<Option<DataType>>, Error> {
        let types = self.plan.get_parameter_types().map_err(|e| Error::plan(&self.sql, &e))?;
        let number = |name: &str| name.strip_prefix('$').and_then(|n| n.parse::<usize>().ok()).filter(|n| *n > 0);
        let mut found = Vec::new();
        for (name, kind) in types {
            let Some(number) = number(&name) else {
                let message = format!("`{name}` is no placeholder");
                return Err(Error::Query { message, place: None, hint: Some("they are $1, $2, ...".to_owned()) });
            };
            if found.len() < number {
                found.resize(number, None);
            }
            found[number - 1] = kind;
        }
        Ok(found)
    }
}

/// An answer, as it comes. Dropping it ends its query.
pub struct Answer {
    /// Its columns.
    pub schema: SchemaRef,
    batches: SendableRecordBatchStream,
}

impl Answer {
    /// The next rows; None after the last.
    ///
    /// # Errors
    /// [`Error::Execution`] where the query fails on its way.
    pub async fn next(&mut self) -> Result<Option<RecordBatch>, Error> {
        self.batches.next().await.transpose().map_err(|e| Error::execution(&e))
    }
}

impl Session {
    /// A session on a lake that nobody else asks, without limits.
    ///
    /// # Errors
    /// [`Error::Execution`] where DataFusion cannot be set up.
    pub fn new(lake: &Lake) -> Result<Self, Error> {
        let client = Client { name: "local".to_owned(), quota: Quota::default() };
        Ok(Engine::new(lake)?.session(&Arc::new(client)))
    }

    pub(crate) fn of(engine: Engine, client: Arc<Client>) -> Self {
        Self { engine, client, extend: None }
    }

    /// The same with a protocol's own tables and functions.
    #[must_use]
    pub fn extended(mut self, extend: Extend) -> Self {
        self.extend = Some(extend);
        self
    }

    /// Who asks.
    pub fn client(&self) -> &Client {
        &self.client
    }

    /// Answers a query.
    ///
    /// # Errors
    /// [`Error::Query`] where it is not right, [`Error::NotReading`] where it would change something,
    /// [`Error::Lake`] where the lake cannot be read.
    pub async fn query(&self, sql: &str) -> Result<Answer, Error> {
        let prepared = self.prepare(sql).await?;
        self.run(&prepared.context, prepared.plan, sql).await
    }

    /// Plans a query.
    ///
    /// # Errors
    /// As [`Session::query`].
    pub async fn prepare(&self, sql: &str) -> Result<Prepared, Error> {
        let statement = self.parse(sql)?;
        self.prepare_statement(sql, statement).await
    }

    /// Plans a statement that a protocol has parsed, and perhaps rewritten, from `sql`.
    ///
    /// # Errors
    /// As [`Session::query`].
    pub async fn prepare_statement(&self, sql: &str, mut statement: Statement) -> Result<Prepared, Error> {
        let wrong = |e: DataFusionError| Error::plan(sql, &e);
        gate::check(&statement)?;
        let context = self.engine.context();
        self.engine.catalog().register(&context, &mut statement).await?;
        if let Some(extend) = &self.extend {
            extend(&context).map_err(|e| Error::execution(&e))?;
        }
        let plan = context.state().statement_to_plan(statement).await.map_err(wrong)?;
        // `SELECT INTO` reads by its first word and makes a table by its plan.
        let reading = SQLOptions::new().with_allow_ddl(false).with_allow_dml(false).with_allow_statements(false);
        reading.verify_plan(&plan).map_err(|_| Error::NotReading { statement: plan.display().to_string() })?;
        Ok(Prepared { context, plan, sql: sql.to_owned() })
    }

    /// Answers a planned query with values for its placeholders.
    ///
    /// # Errors
    /// [`Error::Query`] where values are missing or of the wrong type.
    pub async fn execute(&self, prepared: &Prepared, values: ParamValues) -> Result<Answer, Error> {
        let plan = prepared.plan.clone().with_param_values(values).map_err(|e| Error::plan(&prepared.sql, &e))?;
        self.run(&prepared.context, plan, &prepared.sql).await
    }

    /// Parses one statement.
    ///
    /// # Errors
    /// [`Error::Query`] where it is none.
    pub fn parse(&self, sql: &str) -> Result<Statement, Error> {
        let state = self.engine.context().state();
        let sql = &as_of::respelled(sql);
        state.sql_to_statement(sql, &state.config().options().sql_parser.dialect).map_err(|e| Error::plan(sql, &e))
    }

    async fn run(&self, context: &SessionContext, plan: LogicalPlan, sql: &str) -> Result<Answer, Error> {
        let wrong = |e: DataFusionError| Error::plan(sql, &e);
        let frame = context.execute_logical_plan(plan).await.map_err(wrong)?;
        let batches = frame.execute_stream().await.map_err(wrong)?;
        Ok(Answer { schema: batches.schema(), batches })
    }

    /// The tables and their schemas.
    pub fn tables(&self) -> impl Iterator<Item = (&'static str, SchemaRef)> {
        self.engine.catalog().tables()
    }
}

#[cfg(test)]
mod tests;

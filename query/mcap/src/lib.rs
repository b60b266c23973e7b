//! Runs as tables: `mcap`, `mcap_messages` and `mcap_topics` read MCAP files in the lake's store, as they are.
//!
//! Planning cannot wait for a store, so what a statement asks for is looked up before it is planned; the functions that
//! the planner then calls only hand it over.

mod column;
mod contents;
mod encodings;
mod error;
mod file;
#[cfg(fuzzing)]
mod fuzzing;
mod piece;
mod rows;
mod run_sizes;
mod scan;
mod sent_scan;
mod table;
mod target;
#[cfg(test)]
mod tests;
mod topics;

use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::ops::ControlFlow;
use std::sync::Arc;

use datafusion::catalog::{TableFunctionArgs, TableFunctionImpl, TableProvider};
use datafusion::common::ScalarValue;
use datafusion::error::{DataFusionError, Result as PlanResult};
use datafusion::logical_expr::Expr;
use datafusion::prelude::SessionContext;
use datafusion::sql::sqlparser::ast::{
    Expr as SqlExpr, FunctionArg, FunctionArgExpr, ObjectNamePart, TableFactor, VisitorMut,
};
use echolake_lake::LakeSnapshot;
use echolake_schema::tables::Table;

pub use contents::{Contents, Topic, read_attachment, read_contents};
use error::Fault;
pub use file::{Attachment, McapFiles};
#[cfg(fuzzing)]
pub use fuzzing::EncodedMessage;
pub use scan::{McapExec, ScanPiece};
pub use sent_scan::{decode_mcap_scan, encode_mcap_scan};
use target::Target;

/// What one of the functions may be called with, for whoever calls it otherwise.
const USAGE: &str = "mcap('surface, run or pattern', 'topic'), mcap_messages('...'[, 'topic']) and mcap_topics('...') \
                     take texts, written out";

/// A function of this module.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum Function {
    Columns,
    Messages,
    Topics,
}

impl Function {
    const ALL: [Self; 3] = [Self::Columns, Self::Messages, Self::Topics];

    fn name(self) -> &'static str {
        match self {
            Self::Columns => "mcap",
            Self::Messages => "mcap_messages",
            Self::Topics => "mcap_topics",
        }
    }
}

/// A call with texts.
type Call = (Function, Vec<String>);

/// Makes the functions known to a query's context, and reads ahead what they are called with: which runs of the
/// snapshot, where their messages are, which columns they have.
///
/// # Errors
/// [`DataFusionError::Plan`] for a call that is not right, [`DataFusionError::Execution`] where a file cannot be read,
/// [`DataFusionError::External`] with the lake's error if `runs` is not whole.
pub async fn register(
    context: &SessionContext,
    snapshot: &LakeSnapshot,
    files: &Arc<McapFiles>,
    calls: McapCalls,
) -> PlanResult<()> {
    let mut tables: HashMap<Function, HashMap<Vec<String>, Arc<dyn TableProvider>>> = HashMap::new();
    for (function, arguments) in calls.0 {
        snapshot.check_table(Table::Runs).map_err(|fault| DataFusionError::External(fault.into()))?;
        let of = tables.entry(function).or_default();
        if let Entry::Vacant(place) = of.entry(arguments) {
            let table = table(function, place.key(), snapshot, files).await?;
            place.insert(table);
        }
    }
    for function in Function::ALL {
        let found = Found { tables: tables.remove(&function).unwrap_or_default() };
        context.register_udtf(function.name(), Arc::new(found));
    }
    Ok(())
}

async fn table(
    function: Function,
    arguments: &[String],
    snapshot: &LakeSnapshot,
    files: &Arc<McapFiles>,
) -> Result<Arc<dyn TableProvider>, Fault> {
    let usage = || Fault::invalid_call(format!("{} is called with {} texts", function.name(), arguments.len()), USAGE);
    let pattern = arguments.first().ok_or_else(usage)?;
    let open = || Target::open_all(pattern, snapshot, files);
    Ok(match (function, arguments) {
        (Function::Columns, [_, topic]) => Arc::new(table::decoded_table(open().await?, topic, files)?),
        (Function::Messages, [_]) => Arc::new(table::message_table(open().await?, None, files)?),
        (Function::Messages, [_, topic]) => Arc::new(table::message_table(open().await?, Some(topic), files)?),
        (Function::Topics, [_]) => topics::channel_table(open().await?, files).await?,
        _ => return Err(usage()),
    })
}

/// The tables of one function that a statement names.
#[derive(Debug)]
struct Found {
    tables: HashMap<Vec<String>, Arc<dyn TableProvider>>,
}

impl TableFunctionImpl for Found {
    fn call_with_args(&self, args: TableFunctionArgs<'_, '_>) -> PlanResult<Arc<dyn TableProvider>> {
        let text = |expr: &Expr| match expr {
            Expr::Literal(ScalarValue::Utf8(Some(text)) | ScalarValue::Utf8View(Some(text)), _) => Some(text.clone()),
            _ => None,
        };
        let texts: Option<Vec<_>> = args.exprs().iter().map(text).collect();
        let table = texts.and_then(|texts| self.tables.get(&texts).cloned());
        table.ok_or_else(|| DataFusionError::Plan(USAGE.to_owned()))
    }
}

/// A visitor that finds the calls in a statement whose arguments are texts. Their names are brought into the form that
/// the planner looks them up by: it takes them as they are written.
#[derive(Debug, Default)]
pub struct McapCalls(Vec<Call>);

impl VisitorMut for McapCalls {
    type Break = ();

    fn pre_visit_table_factor(&mut self, factor: &mut TableFactor) -> ControlFlow<()> {
        let (name, arguments) = match factor {
            TableFactor::Table { name, args: Some(arguments), .. } => (name, &arguments.args),
            TableFactor::Function { name, args, .. } => (name, &*args),
            _ => return ControlFlow::Continue(()),
        };
        let [ObjectNamePart::Identifier(name)] = name.0.as_mut_slice() else { return ControlFlow::Continue(()) };
        let meant = |f: &Function| match name.quote_style {
            Some(_) => f.name() == name.value,
            None => f.name() == name.value.to_lowercase(),
        };
        if let Some(function) = Function::ALL.into_iter().find(meant) {
            name.value = function.name().to_owned();
            name.quote_style = None;
            if let Some(texts) = arguments.iter().map(text).collect() {
                self.0.push((function, texts));
            }
        }
        ControlFlow::Continue(())
    }
}

fn text(argument: &FunctionArg) -> Option<String> {
    match argument {
        FunctionArg::Unnamed(FunctionArgExpr::Expr(SqlExpr::Value(value))) => value.value.clone().into_string(),
        _ => None,
    }
}

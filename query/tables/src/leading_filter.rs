//! The part of a filter of found rows that the first column of an order decides.
//!
//! Once a query for the first rows of an order `a, b, c` has found enough, better rows satisfy
//! `a > 7 OR a = 7 AND b < 3 OR ...`, a predicate over all of the order's columns. Few rows satisfy `a > 7 OR a = 7`. So a
//! scan that tests this first reads `a` alone of most rows, and not the names of surfaces and runs.

use std::fmt;
use std::hash::{Hash, Hasher};
use std::sync::Arc;

use arrow::datatypes::{DataType, Field, Schema};
use arrow::record_batch::RecordBatch;
use datafusion::error::Result;
use datafusion::logical_expr::{ColumnarValue, Operator};
use datafusion::physical_expr::expressions::{BinaryExpr, Column, DynamicFilterPhysicalExpr};
use datafusion::physical_expr::utils::{collect_columns, reassign_expr_columns};
use datafusion::physical_expr::{PhysicalExpr, conjunction, split_conjunction};
use datafusion::scalar::ScalarValue;

/// The filter.
#[derive(Debug)]
pub(crate) struct LeadingFilter {
    /// The filter of found rows, a dynamic one: it becomes narrower while they are found.
    found: Arc<dyn PhysicalExpr>,
    /// The order's first column, as `found` names it.
    leading: Column,
    /// The same in the rows to be tested.
    values: Arc<dyn PhysicalExpr>,
}

impl LeadingFilter {
    /// Returns a predicate that the same rows satisfy as `predicate`, and that tests the first columns of orders first.
    /// None if it has no filter of found rows, or one whose order begins with no column.
    pub fn prepend_to(predicate: &Arc<dyn PhysicalExpr>) -> Option<Arc<dyn PhysicalExpr>> {
        let mut parts = Vec::new();
        for part in split_conjunction(predicate) {
            if part.is::<DynamicFilterPhysicalExpr>() {
                parts.push(Arc::new(Self::from_found(part)?) as Arc<dyn PhysicalExpr>);
            }
        }
        (!parts.is_empty()).then(|| conjunction(parts.into_iter().chain([predicate.clone()])))
    }

    fn from_found(found: &Arc<dyn PhysicalExpr>) -> Option<Self> {
        let values = (*found.children().first()?).clone();
        let leading = values.downcast_ref::<Column>()?.clone();
        Some(Self { found: found.clone(), leading, values })
    }

    // What is required of the first column now; None if nothing is.
    fn current_part(&self) -> Result<Option<Arc<dyn PhysicalExpr>>> {
        let Some(found) = self.found.downcast_ref::<DynamicFilterPhysicalExpr>() else { return Ok(None) };
        Ok(self.leading_part(&found.current()?))
    }

    // Each part of the filter that other columns decide is taken for true. None if that is all of it.
    fn leading_part(&self, filter: &Arc<dyn PhysicalExpr>) -> Option<Arc<dyn PhysicalExpr>> {
        if let Some(parts) = filter.downcast_ref::<BinaryExpr>() {
            match parts.op() {
                Operator::And => {
                    let known = [parts.left(), parts.right()].into_iter().filter_map(|part| self.leading_part(part));
                    return known.reduce(|left, right| Arc::new(BinaryExpr::new(left, Operator::And, right)));
                }
                Operator::Or => {
                    let left = self.leading_part(parts.left())?;
                    let right = self.leading_part(parts.right())?;
                    return Some(Arc::new(BinaryExpr::new(left, Operator::Or, right)));
                }
                _ => {}
            }
        }
        collect_columns(filter).iter().all(|column| *column == self.leading).then(|| filter.clone())
    }
}

impl PhysicalExpr for LeadingFilter {
    fn data_type(&self, _: &Schema) -> Result<DataType> {
        Ok(DataType::Boolean)
    }

    fn nullable(&self, _: &Schema) -> Result<bool> {
        Ok(true)
    }

    fn evaluate(&self, batch: &RecordBatch) -> Result<ColumnarValue> {
        let Some(filter) = self.current_part()? else {
            return Ok(ColumnarValue::Scalar(ScalarValue::from(true)));
        };
        let values = self.values.evaluate(batch)?.into_array(batch.num_rows())?;
        let field = Field::new(self.leading.name(), values.data_type().clone(), true);
        let rows = RecordBatch::try_new(Arc::new(Schema::new(vec![field])), vec![values])?;
        reassign_expr_columns(filter, rows.schema_ref())?.evaluate(&rows)
    }

    fn children(&self) -> Vec<&Arc<dyn PhysicalExpr>> {
        vec![&self.values]
    }

    fn with_new_children(self: Arc<Self>, mut children: Vec<Arc<dyn PhysicalExpr>>) -> Result<Arc<dyn PhysicalExpr>> {
        let values = children.pop().unwrap_or_else(|| self.values.clone());
        Ok(Arc::new(Self { found: self.found.clone(), leading: self.leading.clone(), values }))
    }

    fn fmt_sql(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

impl fmt::Display for LeadingFilter {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "first rows by {}", self.values)
    }
}

impl PartialEq for LeadingFilter {
    fn eq(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.found, &other.found) && self.leading == other.leading && *self.values == *other.values
    }
}

impl Eq for LeadingFilter {}

impl Hash for LeadingFilter {
    fn hash<H: Hasher>(&self, state: &mut H) {
        self.leading.hash(state);
        self.values.hash(state);
    }
}

#[cfg(test)]
mod tests {
    use arrow::array::{Array as _, ArrayRef, AsArray as _, Int32Array};
    use datafusion::physical_expr::expressions::{is_null, lit};

    use super::*;

    fn binary(left: &Arc<dyn PhysicalExpr>, op: Operator, right: &Arc<dyn PhysicalExpr>) -> Arc<dyn PhysicalExpr> {
        Arc::new(BinaryExpr::new(left.clone(), op, right.clone()))
    }

    fn satisfied(filter: &dyn PhysicalExpr, rows: &RecordBatch) -> Vec<bool> {
        let values = filter.evaluate(rows).expect("tested").into_array(rows.num_rows()).expect("an array");
        let values = values.as_boolean();
        (0..values.len()).map(|row| values.is_valid(row) && values.value(row)).collect()
    }

    #[test]
    fn it_satisfies_all_rows_that_may_be_better_and_no_others() {
        let values = [None, Some(1), Some(2), Some(3)];
        let pairs: Vec<_> = values.iter().flat_map(|b| values.iter().map(move |a| (*b, *a))).collect();
        let columns: [Int32Array; 2] =
            [pairs.iter().map(|pair| pair.0).collect(), pairs.iter().map(|pair| pair.1).collect()];
        let fields = ["b", "a"].map(|name| Field::new(name, DataType::Int32, true));
        let columns = columns.map(|column| Arc::new(column) as ArrayRef);
        let rows = RecordBatch::try_new(Arc::new(Schema::new(fields.to_vec())), columns.to_vec()).expect("rows");
        let [b, a] =
            [("b", 0), ("a", 1)].map(|(name, place)| Arc::new(Column::new(name, place)) as Arc<dyn PhysicalExpr>);
        let found = Arc::new(DynamicFilterPhysicalExpr::new(vec![a.clone(), b.clone()], lit(true)));
        let predicate: Arc<dyn PhysicalExpr> = found.clone();
        let leading = LeadingFilter::from_found(&predicate).expect("a first column");
        assert_eq!(satisfied(&leading, &rows), vec![true; rows.num_rows()], "nothing is found yet");
        // ORDER BY a NULLS FIRST, b DESC: (2, 1) is the last row that was found.
        let less = binary(&is_null(a.clone()).expect("a test"), Operator::Or, &binary(&a, Operator::Lt, &lit(2)));
        let equal = binary(&a, Operator::Eq, &lit(2));
        let tied = binary(&equal, Operator::And, &binary(&b, Operator::Gt, &lit(1)));
        found.update(binary(&less, Operator::Or, &tied)).expect("updated");
        let better = satisfied(&leading, &rows);
        let expected: Vec<_> = pairs.iter().map(|(_, a)| a.is_none_or(|a| a <= 2)).collect();
        assert_eq!(better, expected);
        let all = satisfied(found.as_ref(), &rows);
        assert!(all.iter().zip(&better).all(|(all, leading)| *leading || !all));
        let whole = LeadingFilter::prepend_to(&predicate).expect("a filter of found rows");
        assert_eq!(satisfied(whole.as_ref(), &rows), all);
        assert!(LeadingFilter::prepend_to(&less).is_none());
    }
}

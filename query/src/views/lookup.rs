//! Functions in the views' SQL. Lookup functions for values that depend on the rig alone, by pair and symmetry:
//! `pair_incidence_deg(pair_id)`, `d4_pair_id(pair_id, symmetry_id)`. They cost one array access per row and stream; a
//! join would not.

use std::hash::{Hash, Hasher};
use std::sync::Arc;

use arrow::array::{Array as _, ArrayRef, AsArray as _, BooleanArray, Float64Array, Int32Array, UInt32Array};
use arrow::compute::take;
use arrow::datatypes::{DataType, Int32Type};
use datafusion::error::Result;
use datafusion::logical_expr::{ColumnarValue, ScalarFunctionArgs, ScalarUDF, ScalarUDFImpl, Signature, Volatility};
use datafusion::prelude::SessionContext;
use echolake_functions::FunctionSet;
use echolake_lake::Lake;
use echolake_schema::symmetry::MovedPair;
use echolake_schema::{Grid, Symmetry};

/// The lookup functions of a lake, and those of the field that views call.
#[derive(Debug, Clone)]
pub(crate) struct LookupFunctions(Vec<Arc<ScalarUDF>>);

/// Prefix of the lookup functions for columns of `pairs`.
const OF_PAIR: &str = "pair_";
/// Prefix of the lookup functions by pair and symmetry.
const OF_MOVED: &str = "d4_";
/// The function of the field that views call.
const OF_ROOMS: &str = "room_parameters";

/// Values of all pairs, or of all pairs under each symmetry of D4, one symmetry after the other.
#[derive(Debug)]
struct LookupFunction {
    name: String,
    /// `[pairs]`, or `[symmetries * pairs]`.
    values: ArrayRef,
    pairs: usize,
    signature: Signature,
}

impl LookupFunctions {
    /// Creates the functions.
    ///
    /// # Errors
    /// If the rig's pairs cannot be laid out.
    pub fn from_lake(lake: &Lake, functions: &FunctionSet) -> echolake_lake::Result<Self> {
        let pairs = lake.pair_rows()?;
        let columns = pairs.schema();
        let own = columns.fields().iter().zip(pairs.columns()).skip(1);
        let mut all: Vec<_> = own
            .map(|(field, values)| LookupFunction::new(OF_PAIR, field.name(), values.clone(), pairs.num_rows(), 1))
            .collect();
        all.extend(moved_lookups(lake.grid()));
        let lookups = all.into_iter().map(|lookup| Arc::new(ScalarUDF::from(lookup)));
        let of_rooms = functions.scalar().iter().filter(|function| function.name() == OF_ROOMS).cloned();
        Ok(Self(lookups.chain(of_rooms).collect()))
    }

    /// Returns the lookup function of a column of `pairs`.
    pub fn of_pair(&self, column: &str) -> Option<&Arc<ScalarUDF>> {
        self.0.iter().find(|function| function.name().strip_prefix(OF_PAIR) == Some(column))
    }

    /// Returns the lookup function of a column of `tnce_d4` that follows from pair and symmetry.
    pub fn of_moved_pair(&self, column: &str) -> Option<&Arc<ScalarUDF>> {
        let is_moved = column.starts_with(OF_MOVED) || column.ends_with("_mm") || column == "swapped";
        let column = Some(column.strip_prefix(OF_MOVED).unwrap_or(column)).filter(|_| is_moved)?;
        self.0.iter().find(|function| function.name().strip_prefix(OF_MOVED) == Some(column))
    }

    /// Returns the symmetries under which each pair has another one, with their ids.
    pub fn moved_symmetries(&self) -> Vec<(i32, Symmetry)> {
        let moved = self.of_moved_pair("d4_pair_id").and_then(|moved| moved.inner().downcast_ref::<LookupFunction>());
        let has = |id: usize| moved.is_some_and(|moved| moved.pairs > 0 && moved.values.is_valid(id * moved.pairs));
        let all = Symmetry::ALL.into_iter().enumerate();
        all.filter(|(id, _)| has(*id)).map(|(id, symmetry)| (id as i32, symmetry)).collect()
    }

    /// Returns whether a function looks a value up by pair, or by pair and symmetry.
    pub fn is_lookup(&self, function: &ScalarUDF) -> bool {
        function.inner().downcast_ref::<LookupFunction>().is_some()
    }

    /// Returns the number of the rig's pairs.
    pub fn count_pairs(&self) -> u64 {
        let lookup = self.0.iter().find_map(|function| function.inner().downcast_ref::<LookupFunction>());
        lookup.map_or(0, |lookup| lookup.pairs as u64)
    }

    /// Returns the functions.
    pub fn functions(&self) -> &[Arc<ScalarUDF>] {
        &self.0
    }

    pub fn register_functions(&self, context: &SessionContext) {
        for function in &self.0 {
            context.register_udf(function.as_ref().clone());
        }
    }
}

fn moved_lookups(grid: &Grid) -> Vec<LookupFunction> {
    // A symmetry that the grid lacks is in no view; nulls fill its place, so that the ids stay the same.
    let moved: Vec<Option<MovedPair>> = Symmetry::ALL
        .into_iter()
        .flat_map(|s| match grid.moved_pairs(s) {
            Some(pairs) => pairs.into_iter().map(Some).collect(),
            None => vec![None; grid.pairs().len()],
        })
        .collect();
    let int = |f: fn(&MovedPair) -> u32| -> ArrayRef {
        Arc::new(moved.iter().map(|m| m.as_ref().map(|m| f(m) as i32)).collect::<Int32Array>())
    };
    let axis = |end: fn(&Grid, &MovedPair) -> Option<[f64; 3]>, i: usize| -> ArrayRef {
        Arc::new(moved.iter().map(|m| m.as_ref().and_then(|m| end(grid, m)).map(|p| p[i])).collect::<Float64Array>())
    };
    let swapped: BooleanArray = moved.iter().map(|m| m.as_ref().map(|m| m.swapped)).collect();
    let mut columns: Vec<(String, ArrayRef)> = vec![
        ("swapped".into(), Arc::new(swapped)),
        ("pair_id".into(), int(|m| m.pair.id.0)),
        ("microphone".into(), int(|m| m.pair.microphone.0)),
        ("speaker".into(), int(|m| m.pair.speaker.0)),
    ];
    for (i, name) in ["x_mm", "y_mm", "z_mm"].into_iter().enumerate() {
        let microphone = axis(|g, m| g.point(m.pair.microphone).map(|p| p.position_mm), i);
        let speaker = axis(|g, m| g.point(m.pair.speaker).map(|p| p.position_mm), i);
        columns.extend([(format!("microphone_{name}"), microphone), (format!("speaker_{name}"), speaker)]);
    }
    columns
        .into_iter()
        .map(|(name, values)| LookupFunction::new(OF_MOVED, &name, values, grid.pairs().len(), 2))
        .collect()
}

impl LookupFunction {
    fn new(prefix: &str, name: &str, values: ArrayRef, pairs: usize, arguments: usize) -> Self {
        let signature = Signature::exact(vec![DataType::Int32; arguments], Volatility::Immutable);
        Self { name: format!("{prefix}{name}"), values, pairs, signature }
    }

    fn value_index(&self, pair: Option<i32>, symmetry: Option<i32>) -> Option<u32> {
        let pair = usize::try_from(pair?).ok().filter(|p| *p < self.pairs)?;
        let index = usize::try_from(symmetry?).ok()?.checked_mul(self.pairs)?.checked_add(pair)?;
        u32::try_from(index).ok().filter(|_| index < self.values.len())
    }
}

// The same name with other values belongs to another lake.
impl PartialEq for LookupFunction {
    fn eq(&self, other: &Self) -> bool {
        self.name == other.name && Arc::ptr_eq(&self.values, &other.values)
    }
}

impl Eq for LookupFunction {}

impl Hash for LookupFunction {
    fn hash<H: Hasher>(&self, state: &mut H) {
        self.name.hash(state);
    }
}

impl ScalarUDFImpl for LookupFunction {
    fn name(&self) -> &str {
        &self.name
    }

    fn signature(&self) -> &Signature {
        &self.signature
    }

    fn return_type(&self, _arguments: &[DataType]) -> Result<DataType> {
        Ok(self.values.data_type().clone())
    }

    fn invoke_with_args(&self, args: ScalarFunctionArgs) -> Result<ColumnarValue> {
        let rows = args.number_rows;
        let columns = args.args.iter().map(|a| a.to_array(rows)).collect::<Result<Vec<_>>>()?;
        let pairs = columns[0].as_primitive::<Int32Type>();
        let indices: UInt32Array = match columns.get(1) {
            Some(symmetries) => {
                let symmetries = symmetries.as_primitive::<Int32Type>();
                pairs.iter().zip(symmetries).map(|(p, s)| self.value_index(p, s)).collect()
            }
            None => pairs.unary_opt(|p| self.value_index(Some(p), Some(0))),
        };
        Ok(ColumnarValue::Array(take(&self.values, &indices, None)?))
    }
}

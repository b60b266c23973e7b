//! Adapter from an aggregate function to DataFusion, over one group or many at once.

use std::fmt::{self, Debug};

use arrow::array::{ArrayRef, BooleanArray};
use arrow::datatypes::{DataType, Field, FieldRef};
use datafusion::common::ScalarValue;
use datafusion::error::{DataFusionError, Result};
use datafusion::logical_expr::function::{AccumulatorArgs, StateFieldsArgs};
use datafusion::logical_expr::utils::format_state_name;
use datafusion::logical_expr::{
    Accumulator, AggregateUDF, AggregateUDFImpl, Documentation, EmitTo, GroupsAccumulator, Signature, Volatility,
};

use super::arguments::{CallArguments, check_arguments, coerced_types};
use super::description::FunctionDescription;
use super::scalar::identify_by_name;

/// A function of the values of many rows. Null rows do not count.
pub(crate) trait AggregateKernel: Send + Sync + Clone + 'static {
    /// State of one group.
    type Group: Default + Debug + Send + Sync;

    /// Returns the function's description.
    fn description(&self) -> &'static FunctionDescription;

    /// Returns the type of its answer; the arguments' types are already checked.
    fn answer_type(&self, arguments: &[DataType]) -> DataType;

    /// Returns names and types of the state's columns, which are passed between the steps of a query.
    fn state_columns(&self) -> Vec<(&'static str, DataType)>;

    /// Adds a batch of rows to the groups.
    ///
    /// # Errors
    /// If a value is invalid; the error names its row.
    fn update_groups(&self, arguments: &CallArguments<'_>, groups: &mut GroupStates<'_, Self>) -> Result<()>;

    /// Merges states of other partial aggregations into the groups.
    ///
    /// # Errors
    /// If a state does not fit the one here.
    fn merge_states(&self, states: &[ArrayRef], groups: &mut GroupStates<'_, Self>) -> Result<()>;

    /// Returns the states, one row per group.
    ///
    /// # Errors
    /// If there are more values than an array can hold.
    fn group_states(&self, groups: &[Self::Group]) -> Result<Vec<ArrayRef>>;

    /// Returns the answers, one row per group.
    ///
    /// # Errors
    /// If there are more values than an array can hold.
    fn group_answers(&self, groups: &[Self::Group], returns: &DataType) -> Result<ArrayRef>;

    /// Returns the bytes that a group holds on the heap.
    fn heap_bytes(_group: &Self::Group) -> usize {
        0
    }
}

/// The groups that a batch's rows belong to.
pub(crate) struct GroupStates<'a, A: AggregateKernel> {
    all: &'a mut [A::Group],
    heap: &'a mut usize,
    /// Index of each row's group; None if all rows belong to the first.
    of: Option<&'a [usize]>,
    filter: Option<&'a BooleanArray>,
}

impl<A: AggregateKernel> GroupStates<'_, A> {
    /// Updates the group of a row, unless the filter excludes the row.
    pub fn update_at(&mut self, row: usize, change: impl FnOnce(&mut A::Group) -> Result<()>) -> Result<()> {
        if self.filter.is_some_and(|filter| !filter.value(row) || arrow::array::Array::is_null(filter, row)) {
            return Ok(());
        }
        let Some(group) = self.all.get_mut(self.of.map_or(0, |of| of[row])) else { return Ok(()) };
        let before = A::heap_bytes(group);
        let done = change(group);
        *self.heap += A::heap_bytes(group).saturating_sub(before);
        done
    }
}

/// Adapts an [`AggregateKernel`] to DataFusion's trait.
struct AggregateAdapter<A> {
    function: A,
    signature: Signature,
    documentation: Documentation,
}

/// Accumulator of groups; a single group if there is no GROUP BY.
struct Accumulated<A: AggregateKernel> {
    function: A,
    returns: DataType,
    groups: Vec<A::Group>,
    heap: usize,
}

/// Wraps the function for DataFusion.
pub(crate) fn wrap_aggregate(function: impl AggregateKernel) -> AggregateUDF {
    let documentation = function.description().build_documentation();
    AggregateUDF::new_from_impl(AggregateAdapter {
        function,
        signature: Signature::user_defined(Volatility::Immutable),
        documentation,
    })
}

impl<A: AggregateKernel> AggregateAdapter<A> {
    fn create_accumulated(&self, args: &AccumulatorArgs<'_>) -> Result<Accumulated<A>> {
        if args.is_distinct {
            let name = self.function.description().name;
            let hint = "take them from a subquery with SELECT DISTINCT";
            return Err(DataFusionError::Plan(format!("`{name}` knows no DISTINCT; hint: {hint}")));
        }
        let returns = args.return_field.data_type().clone();
        Ok(Accumulated { function: self.function.clone(), returns, groups: Vec::new(), heap: 0 })
    }
}

impl<A: AggregateKernel> AggregateUDFImpl for AggregateAdapter<A> {
    fn name(&self) -> &str {
        self.function.description().name
    }

    fn signature(&self) -> &Signature {
        &self.signature
    }

    fn coerce_types(&self, types: &[DataType]) -> Result<Vec<DataType>> {
        Ok(coerced_types(self.function.description(), types))
    }

    fn return_type(&self, types: &[DataType]) -> Result<DataType> {
        check_arguments(self.function.description(), types)?;
        Ok(self.function.answer_type(types))
    }

    fn state_fields(&self, args: StateFieldsArgs) -> Result<Vec<FieldRef>> {
        let field = |(name, kind)| Field::new(format_state_name(args.name, name), kind, true).into();
        Ok(self.function.state_columns().into_iter().map(field).collect())
    }

    fn accumulator(&self, args: AccumulatorArgs) -> Result<Box<dyn Accumulator>> {
        let mut one = self.create_accumulated(&args)?;
        one.groups.push(A::Group::default());
        Ok(Box::new(one))
    }

    fn groups_accumulator_supported(&self, args: AccumulatorArgs) -> bool {
        !args.is_distinct
    }

    fn create_groups_accumulator(&self, args: AccumulatorArgs) -> Result<Box<dyn GroupsAccumulator>> {
        Ok(Box::new(self.create_accumulated(&args)?))
    }

    fn documentation(&self) -> Option<&Documentation> {
        Some(&self.documentation)
    }
}

impl<A: AggregateKernel> Accumulated<A> {
    fn update_groups(
        &mut self,
        values: &[ArrayRef],
        of: Option<&[usize]>,
        filter: Option<&BooleanArray>,
    ) -> Result<()> {
        let Self { function, groups, heap, .. } = self;
        let arguments = CallArguments::from_batch(function.description(), values);
        function.update_groups(&arguments, &mut GroupStates { all: groups, heap, of, filter })
    }

    fn merge_states(&mut self, states: &[ArrayRef], of: Option<&[usize]>) -> Result<()> {
        let Self { function, groups, heap, .. } = self;
        function.merge_states(states, &mut GroupStates { all: groups, heap, of, filter: None })
    }

    fn take_groups(&mut self, emit: EmitTo) -> Vec<A::Group> {
        let taken = emit.take_needed(&mut self.groups);
        self.heap -= taken.iter().map(A::heap_bytes).sum::<usize>().min(self.heap);
        taken
    }

    fn held_bytes(&self) -> usize {
        size_of::<Self>() + self.groups.capacity() * size_of::<A::Group>() + self.heap
    }
}

impl<A: AggregateKernel> Accumulator for Accumulated<A> {
    fn update_batch(&mut self, values: &[ArrayRef]) -> Result<()> {
        self.update_groups(values, None, None)
    }

    fn merge_batch(&mut self, states: &[ArrayRef]) -> Result<()> {
        self.merge_states(states, None)
    }

    fn evaluate(&mut self) -> Result<ScalarValue> {
        ScalarValue::try_from_array(&self.function.group_answers(&self.groups, &self.returns)?, 0)
    }

    fn state(&mut self) -> Result<Vec<ScalarValue>> {
        let columns = self.function.group_states(&self.groups)?;
        columns.iter().map(|column| ScalarValue::try_from_array(column, 0)).collect()
    }

    fn size(&self) -> usize {
        self.held_bytes()
    }
}

impl<A: AggregateKernel> GroupsAccumulator for Accumulated<A> {
    fn update_batch(
        &mut self,
        values: &[ArrayRef],
        of: &[usize],
        filter: Option<&BooleanArray>,
        total: usize,
    ) -> Result<()> {
        self.groups.resize_with(total, A::Group::default);
        self.update_groups(values, Some(of), filter)
    }

    fn merge_batch(&mut self, states: &[ArrayRef], of: &[usize], total: usize) -> Result<()> {
        self.groups.resize_with(total, A::Group::default);
        self.merge_states(states, Some(of))
    }

    fn evaluate(&mut self, emit: EmitTo) -> Result<ArrayRef> {
        let groups = self.take_groups(emit);
        self.function.group_answers(&groups, &self.returns)
    }

    fn state(&mut self, emit: EmitTo) -> Result<Vec<ArrayRef>> {
        let groups = self.take_groups(emit);
        self.function.group_states(&groups)
    }

    fn convert_to_state(&self, values: &[ArrayRef], filter: Option<&BooleanArray>) -> Result<Vec<ArrayRef>> {
        let arguments = CallArguments::from_batch(self.function.description(), values);
        let of: Vec<usize> = (0..arguments.row_count()).collect();
        let mut groups = Vec::new();
        groups.resize_with(of.len(), A::Group::default);
        let rows = &mut GroupStates { all: &mut groups, heap: &mut 0, of: Some(&of), filter };
        self.function.update_groups(&arguments, rows)?;
        self.function.group_states(&groups)
    }

    fn size(&self) -> usize {
        self.held_bytes()
    }
}

impl<A: AggregateKernel> Debug for Accumulated<A> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} of {} groups", self.function.description().name, self.groups.len())
    }
}

identify_by_name!(AggregateAdapter, AggregateKernel);

//! `diffusion` of a list of levels, `diffusion_normalised` of two, and `diffusion_coefficient` of many rows.

use std::sync::Arc;

use arrow::array::{ArrayRef, AsArray as _, Float64Array, UInt64Array};
use arrow::datatypes::{DataType, Float64Type, UInt64Type};
use datafusion::error::Result;
use echolake_dsp::Error;
use echolake_dsp::diffusion::{DiffusionSums, diffusion_of_levels, normalise_diffusion};

use crate::adapters::aggregate::{AggregateKernel, GroupStates};
use crate::adapters::answers::build_numbers;
use crate::adapters::arguments::{CallArguments, SampleElement};
use crate::adapters::description::{ArgumentKind, FunctionDescription, FunctionFamily, FunctionParameter};
use crate::adapters::scalar::ScalarKernel;

/// `diffusion`.
pub(crate) struct DiffusionFunction;

/// `diffusion_normalised`.
pub(crate) struct DiffusionNormalisedFunction;

/// `diffusion_coefficient`.
#[derive(Clone)]
pub(crate) struct DiffusionCoefficientFunction;

static LIST: FunctionDescription = FunctionDescription {
    name: "diffusion",
    family: FunctionFamily::Comparison,
    about: "Directional diffusion coefficient of a list of levels at receivers around a surface, without unit: ((sum \
            e)^2 - sum e^2) / ((n - 1) sum e^2), e = 10^(L/10), 1 where all are equal, 0 where all energy is at one. \
            It has the form of ISO 17497-2, with equal weights; but that asks for receivers in the far field, and the \
            grid of a rig is in the near field, so compare it with surfaces measured alike only. Null for fewer than \
            two levels or no sound.",
    parameters: &[FunctionParameter {
        name: "levels_db",
        kind: ArgumentKind::Samples,
        about: "levels, dB; minus infinity is no sound",
    }],
    optional: 0,
    example: "select diffusion([60, 60, 60, 60]) as even, round(diffusion([60, 30, 30, 30]), 4) as focused",
    answer: "\
+------+---------+
| even | focused |
+------+---------+
| 1.0  | 0.002   |
+------+---------+",
    related: &["diffusion_normalised", "diffusion_coefficient"],
};

static NORMALISED: FunctionDescription = FunctionDescription {
    name: "diffusion_normalised",
    family: FunctionFamily::Comparison,
    about: "Diffusion coefficient d of a surface, normalised by that of a flat panel of the same size, without unit: \
            (d - d_flat) / (1 - d_flat), each by diffusion(), as ISO 17497-2 defines it for receivers in the far \
            field. 0 is as even as the flat panel, negative less even. Null where one of them is null, or the flat \
            panel's is 1. Columns diffusion_normalised_* of surfaces have it for reliefs, computed.",
    parameters: &[
        FunctionParameter { name: "levels_db", kind: ArgumentKind::Samples, about: "levels over the surface, dB" },
        FunctionParameter {
            name: "flat_levels_db",
            kind: ArgumentKind::Samples,
            about: "levels at the same receivers over the flat panel, dB",
        },
    ],
    optional: 0,
    example: "select round(diffusion_normalised([60, 57, 63], [60, 45, 40]), 4) as d",
    answer: "\
+--------+
| d      |
+--------+
| 0.6537 |
+--------+",
    related: &["diffusion"],
};

static ROWS: FunctionDescription = FunctionDescription {
    name: "diffusion_coefficient",
    family: FunctionFamily::Aggregates,
    about: "Directional diffusion coefficient over rows, one a receiver; see diffusion(), whose reservation about the \
            near field holds here too. Take the rows of one speaker position. Null levels do not count; a receiver \
            without sound is minus infinity.",
    parameters: &[FunctionParameter {
        name: "level_db",
        kind: ArgumentKind::Number,
        about: "level at one receiver, dB",
    }],
    optional: 0,
    example: "select round(diffusion_coefficient(level), 4) as d from (values (60), (57), (63)) as \
              receivers(level)",
    answer: "\
+--------+
| d      |
+--------+
| 0.6682 |
+--------+",
    related: &["diffusion", "p90_mean"],
};

impl ScalarKernel for DiffusionFunction {
    fn description(&self) -> &'static FunctionDescription {
        &LIST
    }

    fn answer_type(&self, _: &[DataType]) -> DataType {
        DataType::Float64
    }

    fn compute_answers<T: SampleElement>(&self, arguments: &CallArguments<'_>) -> Result<ArrayRef> {
        let levels = arguments.sample_lists::<T>(0)?;
        build_numbers(arguments, |row| Ok(diffusion_of_levels(levels.samples_at(row)?)))
    }
}

impl ScalarKernel for DiffusionNormalisedFunction {
    fn description(&self) -> &'static FunctionDescription {
        &NORMALISED
    }

    fn answer_type(&self, _: &[DataType]) -> DataType {
        DataType::Float64
    }

    fn compute_answers<T: SampleElement>(&self, arguments: &CallArguments<'_>) -> Result<ArrayRef> {
        let levels = arguments.sample_lists::<T>(0)?;
        let flat_levels = arguments.sample_lists::<T>(1)?;
        build_numbers(arguments, |row| {
            let levels = levels.samples_at(row)?;
            let flat_levels = flat_levels.samples_at(row)?;
            if levels.len() != flat_levels.len() {
                let error = Error::Length { what: "flat_levels_db", actual: flat_levels.len(), expected: levels.len() };
                return Err(arguments.refused_row(row, &error));
            }
            let both = diffusion_of_levels(levels).zip(diffusion_of_levels(flat_levels));
            Ok(both.and_then(|(relief, flat)| normalise_diffusion(relief, flat)))
        })
    }
}

impl AggregateKernel for DiffusionCoefficientFunction {
    type Group = DiffusionSums;

    fn description(&self) -> &'static FunctionDescription {
        &ROWS
    }

    fn answer_type(&self, _: &[DataType]) -> DataType {
        DataType::Float64
    }

    fn state_columns(&self) -> Vec<(&'static str, DataType)> {
        let number = |name| (name, DataType::Float64);
        vec![("receivers", DataType::UInt64), number("loudest_db"), number("energy"), number("square")]
    }

    fn update_groups(&self, arguments: &CallArguments<'_>, groups: &mut GroupStates<'_, Self>) -> Result<()> {
        let levels = arguments.number_values(0)?;
        for row in (0..arguments.row_count()).filter(|row| !arguments.is_null(*row)) {
            groups.update_at(row, |group| {
                group.add_level(levels.value_at(row));
                Ok(())
            })?;
        }
        Ok(())
    }

    fn merge_states(&self, states: &[ArrayRef], groups: &mut GroupStates<'_, Self>) -> Result<()> {
        let receivers = states[0].as_primitive::<UInt64Type>().values();
        let [loudest, energy, square] = [1, 2, 3].map(|i| states[i].as_primitive::<Float64Type>().values());
        let parts = receivers.iter().zip(loudest).zip(energy.iter().zip(square));
        for (row, ((receivers, loudest), (energy, square))) in parts.enumerate() {
            groups.update_at(row, |group| {
                group.merge(&DiffusionSums::from_parts((*receivers, *loudest, *energy, *square)));
                Ok(())
            })?;
        }
        Ok(())
    }

    fn group_states(&self, groups: &[DiffusionSums]) -> Result<Vec<ArrayRef>> {
        let parts = || groups.iter().map(DiffusionSums::parts);
        let number = |values: Vec<f64>| -> ArrayRef { Arc::new(Float64Array::from(values)) };
        Ok(vec![
            Arc::new(parts().map(|p| Some(p.0)).collect::<UInt64Array>()),
            number(parts().map(|p| p.1).collect()),
            number(parts().map(|p| p.2).collect()),
            number(parts().map(|p| p.3).collect()),
        ])
    }

    fn group_answers(&self, groups: &[DiffusionSums], _: &DataType) -> Result<ArrayRef> {
        Ok(Arc::new(groups.iter().map(DiffusionSums::coefficient).collect::<Float64Array>()))
    }
}

//! `band_energy`: a response's energy in each band of the lake's filter bank.

use std::sync::Arc;

use arrow::array::ArrayRef;
use arrow::datatypes::{DataType, Fields};
use datafusion::error::Result;
use echolake_dsp::filter_bank::FilterBankPlan;

use crate::adapters::answers::{build_numbers, build_structs, number_fields};
use crate::adapters::arguments::{CallArguments, SampleElement, SampleLists};
use crate::adapters::description::{ArgumentKind, FunctionDescription, FunctionFamily, FunctionParameter};
use crate::adapters::per_length::PerLength;
use crate::adapters::rig::RigFacts;
use crate::adapters::scalar::ScalarKernel;

/// `band_energy`.
pub(crate) struct BandEnergyFunction {
    facts: Arc<RigFacts>,
    fields: Fields,
}

static DESCRIPTION: FunctionDescription = FunctionDescription {
    name: "band_energy",
    family: FunctionFamily::Responses,
    about: "Energy of a response, sum of squares, in each band of the lake's itersine filter bank: a struct with a \
            field a band, `energy_2500` and so on as in table tnce, and `energy_total`, their sum; of one band where \
            its centre is given. Null for a list without samples.",
    parameters: &[
        FunctionParameter {
            name: "ir",
            kind: ArgumentKind::Samples,
            about: "the response at the lake's sampling rate, as reflected_ir",
        },
        FunctionParameter { name: "centre_hz", kind: ArgumentKind::Number, about: "centre of one band, Hz" },
    ],
    optional: 1,
    example: "select band_energy([1, 0])['energy_total'] as total, round(band_energy(reflected_ir, 2500) / \
              energy_2500, 3) as ratio from nce join tnce on nce.run_id = tnce.run_id and nce.pair_id = \
              tnce.pair_id where nce.surface_id = '0015_0' and nce.pair_id = 0",
    answer: "\
+-------+-------+
| total | ratio |
+-------+-------+
| 1.0   | 1.0   |
+-------+-------+",
    related: &["nce", "list_energy", "spectrum"],
};

impl BandEnergyFunction {
    pub fn new(facts: &Arc<RigFacts>) -> Self {
        let mut names: Vec<_> = facts.band_names.iter().map(|name| format!("energy_{name}")).collect();
        names.push("energy_total".into());
        Self { facts: facts.clone(), fields: number_fields(names.iter().map(String::as_str)) }
    }

    /// Returns a function that writes a row's energies into a slice; it returns false if the row has no samples.
    fn energy_writer<'a, T: SampleElement>(
        &'a self,
        arguments: &'a CallArguments<'_>,
        ir: &'a SampleLists<'a, T>,
    ) -> impl FnMut(usize, &mut [f64]) -> Result<bool> + 'a {
        let RigFacts { rate_hz, centres_hz, .. } = &*self.facts;
        let mut plans = PerLength::new(DESCRIPTION.name);
        move |row, energies| {
            let ir = ir.samples_at(row)?;
            if ir.is_empty() {
                return Ok(false);
            }
            let (plan, scratch) = plans.plan_for(ir.len(), |len| {
                let plan = FilterBankPlan::<T>::new(len, *rate_hz, centres_hz)?;
                let scratch = plan.make_scratch();
                Ok((plan, scratch))
            })?;
            plan.compute_energies(ir, energies, scratch).map_err(|e| arguments.refused_row(row, &e))?;
            Ok(true)
        }
    }
}

impl ScalarKernel for BandEnergyFunction {
    fn description(&self) -> &'static FunctionDescription {
        &DESCRIPTION
    }

    fn answer_type(&self, arguments: &[DataType]) -> DataType {
        if arguments.len() > 1 { DataType::Float64 } else { DataType::Struct(self.fields.clone()) }
    }

    fn compute_answers<T: SampleElement>(&self, arguments: &CallArguments<'_>) -> Result<ArrayRef> {
        let ir = arguments.sample_lists::<T>(0)?;
        let bands = self.facts.centres_hz.len();
        let mut energies = self.energy_writer(arguments, &ir);
        if arguments.argument_count() == 1 {
            return build_structs(arguments, &self.fields, |row, values| {
                let there = energies(row, &mut values[..bands])?;
                values[bands] = values[..bands].iter().sum();
                Ok(there)
            });
        }
        let centre = arguments.number_values(1)?;
        let mut all = vec![0.0; bands];
        build_numbers(arguments, |row| {
            let centre = centre.value_at(row);
            let band = self.facts.band_index(centre);
            let band = band.ok_or_else(|| arguments.invalid_argument(1, row, centre, &self.facts.bands_hint()))?;
            Ok(energies(row, &mut all)?.then(|| all[band]))
        })
    }
}

//! `nce`: the normalised cumulative energy curve of a response.

use std::sync::Arc;

use arrow::array::ArrayRef;
use arrow::datatypes::DataType;
use datafusion::error::Result;
use echolake_dsp::energy::cumulate_whole;
use echolake_dsp::filter_bank::FilterBankPlan;

use crate::adapters::answers::{append_defaults, build_lists};
use crate::adapters::arguments::{CallArguments, SampleElement, same_list_type};
use crate::adapters::description::{ArgumentKind, FunctionDescription, FunctionFamily, FunctionParameter};
use crate::adapters::per_length::PerLength;
use crate::adapters::rig::RigFacts;
use crate::adapters::scalar::ScalarKernel;

/// `nce`.
pub(crate) struct NceFunction(pub Arc<RigFacts>);

static DESCRIPTION: FunctionDescription = FunctionDescription {
    name: "nce",
    family: FunctionFamily::Responses,
    about: "Normalised cumulative energy (NCE): the energy of a response up to each of its samples over Flat's total \
            energy for the same pair; the last value is TNCE. Of the whole response, or of one band where its centre \
            is given, as the columns `nce_2500` and so on of table nce. Null where Flat has no energy.",
    parameters: &[
        FunctionParameter {
            name: "ir",
            kind: ArgumentKind::Samples,
            about: "the response with Foam's subtracted, as reflected_ir",
        },
        FunctionParameter {
            name: "flat_energy",
            kind: ArgumentKind::Number,
            about: "Flat's energy of the pair, sum of squares, all bands",
        },
        FunctionParameter { name: "centre_hz", kind: ArgumentKind::Number, about: "centre of one band, Hz" },
    ],
    optional: 1,
    example: "select nce([1, 2, 0, 1], 8) as curve",
    answer: "\
+-----------------------------+
| curve                       |
+-----------------------------+
| [0.125, 0.625, 0.625, 0.75] |
+-----------------------------+",
    related: &["band_energy", "list_db", "edc"],
};

impl ScalarKernel for NceFunction {
    fn description(&self) -> &'static FunctionDescription {
        &DESCRIPTION
    }

    fn answer_type(&self, arguments: &[DataType]) -> DataType {
        same_list_type(&arguments[0])
    }

    fn compute_answers<T: SampleElement>(&self, arguments: &CallArguments<'_>) -> Result<ArrayRef> {
        let ir = arguments.sample_lists::<T>(0)?;
        let flat = arguments.number_values(1)?;
        let room = ir.sample_capacity(arguments.row_count());
        if arguments.argument_count() == 2 {
            return build_lists::<T>(arguments, room, |row, out| {
                let ir = ir.samples_at(row)?;
                let flat = flat.value_at(row);
                cumulate_whole(ir, flat, append_defaults(out, ir.len()));
                Ok(flat > 0.0)
            });
        }
        let centre = arguments.number_values(2)?;
        let mut plans = PerLength::new(DESCRIPTION.name);
        build_lists::<T>(arguments, room, |row, out| {
            let ir = ir.samples_at(row)?;
            let flat = flat.value_at(row);
            let centre = centre.value_at(row);
            let band = self.0.band_index(centre);
            let band = band.ok_or_else(|| arguments.invalid_argument(2, row, centre, &self.0.bands_hint()))?;
            if ir.is_empty() {
                return Ok(flat > 0.0);
            }
            let (plan, scratch, bands) = plans.plan_for(ir.len(), |len| {
                let plan = FilterBankPlan::<T>::new(len, self.0.rate_hz, &self.0.centres_hz)?;
                let scratch = plan.make_scratch();
                let bands = vec![T::default(); plan.band_count() * len];
                Ok((plan, scratch, bands))
            })?;
            plan.split_bands(ir, bands, scratch).map_err(|e| arguments.refused_row(row, &e))?;
            cumulate_whole(&bands[band * ir.len()..][..ir.len()], flat, append_defaults(out, ir.len()));
            Ok(flat > 0.0)
        })
    }
}

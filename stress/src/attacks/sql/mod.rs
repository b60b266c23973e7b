//! Hostile SQL, a family in each file. Statements are texts; those that are long are made when they are needed.

mod allocations;
mod expressions;
mod functions;
mod joins;
mod planning;
mod sql_attack;
mod tables;
mod windows;

pub(crate) use sql_attack::SqlAttack;

/// The statements, by family.
pub(crate) const SQL_FAMILIES: [(&str, &[SqlAttack]); 7] = [
    ("expressions", expressions::ATTACKS),
    ("planning", planning::ATTACKS),
    ("allocations", allocations::ATTACKS),
    ("windows", windows::ATTACKS),
    ("functions", functions::ATTACKS),
    ("joins", joins::ATTACKS),
    ("tables", tables::ATTACKS),
];

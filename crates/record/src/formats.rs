//! Formats whose files are read as a whole. The CSV reader, which streams, is in `csv_reader`.

pub(crate) mod at2;
pub(crate) mod cosmos;
pub(crate) mod csmip;
pub(crate) mod frames;
pub(crate) mod matlab;
pub(crate) mod mcap;
pub(crate) mod mini_seed;
pub(crate) mod smc;
pub(crate) mod table;
pub(crate) mod tdms;
pub(crate) mod text_lines;
pub(crate) mod uff58;

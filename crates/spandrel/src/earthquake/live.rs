//! Makes the reports of the service `reports`, by the same steps as `spandrel earthquake`.

use super::course::Course;
use super::event_record::EventRecord;
use super::report::{EventName, ReportSettings};
use super::storeys::with_displacements;
use super::{index, page};
use crate::error::AppError;
use spandrel_earthquake::urgency::with_peak;
use spandrel_reports::{MadeReport, ReportCourse, ReportIndex, ReportMaker};
use spandrel_structure::{EarthquakePlan, Structure};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Makes the reports of one structure.
#[derive(Debug)]
pub struct LiveReports {
    structure: Arc<Structure>,
    /// Structure file, to which matrix files are relative.
    file: PathBuf,
    settings: ReportSettings,
}

/// The events of one structure, one after the other.
#[derive(Debug)]
struct LiveCourse {
    structure: Arc<Structure>,
    course: Course,
}

impl LiveReports {
    /// Creates what makes the reports of a structure.
    pub fn new(structure: Arc<Structure>, file: &Path, plan: &EarthquakePlan) -> Self {
        Self {
            structure,
            file: file.to_owned(),
            settings: ReportSettings::of(Some(plan)),
        }
    }
}

impl ReportMaker for LiveReports {
    fn begin(&self) -> Result<Box<dyn ReportCourse>, String> {
        let with = with_displacements((*self.structure).clone(), &self.file);
        let course = Course::new(with, self.settings).map_err(|error| told(&error))?;
        Ok(Box::new(LiveCourse {
            structure: self.structure.clone(),
            course,
        }))
    }

    fn index(&self, folder: &Path, waiting: &[String]) -> Result<ReportIndex, String> {
        let entries = index::entries(folder).map_err(|error| told(&error))?;
        let json = serde_json::to_string(&entries).map_err(|error| error.to_string())?;
        Ok(ReportIndex {
            html: index::html(&entries, waiting),
            json,
        })
    }
}

impl ReportCourse for LiveCourse {
    fn report(
        &mut self,
        record: &Path,
        occasion: &str,
        standing: &[String],
    ) -> Result<MadeReport, String> {
        let record =
            EventRecord::read_frames(&self.structure, record).map_err(|error| told(&error))?;
        let name = EventName::new(&self.structure, &record);
        let report = self.course.report(&record, name, standing);
        let report = report.map_err(|error| told(&error))?;
        Ok(MadeReport {
            html: page::html(&report, &record.channels, occasion),
            json: report.json(),
            urgency: report.urgency.words().to_owned(),
            headline: with_peak(&report.headline, report.peak_m_per_s2),
        })
    }
}

fn told(error: &AppError) -> String {
    error.report()
}

-- Whatever is kept over time: one row for each quantity of each structure.
CREATE TABLE series (
  id BIGINT NOT NULL PRIMARY KEY,
  structure TEXT NOT NULL, -- root/structure, as in key expressions
  kind TEXT NOT NULL,
  name TEXT NOT NULL,
  UNIQUE (structure, kind, name)
);

-- Values as they were displayed. Clustered by series and time: a plot reads neighbours.
CREATE TABLE point (
  series BIGINT NOT NULL,
  time_ns BIGINT NOT NULL,
  mean DOUBLE PRECISION NOT NULL,
  std DOUBLE PRECISION NOT NULL,
  probability DOUBLE PRECISION NOT NULL,
  PRIMARY KEY (series, time_ns)
) WITHOUT ROWID;

-- Values put together by minute, hour and day, as sums that can be added to.
CREATE TABLE bucket (
  series BIGINT NOT NULL,
  resolution_s BIGINT NOT NULL,
  start_s BIGINT NOT NULL,
  first_ns BIGINT NOT NULL,
  last_ns BIGINT NOT NULL,
  count BIGINT NOT NULL,
  mean_sum DOUBLE PRECISION NOT NULL,
  square_sum DOUBLE PRECISION NOT NULL,
  variance_sum DOUBLE PRECISION NOT NULL,
  least DOUBLE PRECISION NOT NULL,
  largest DOUBLE PRECISION NOT NULL,
  low DOUBLE PRECISION NOT NULL,
  high DOUBLE PRECISION NOT NULL,
  probability DOUBLE PRECISION NOT NULL,
  PRIMARY KEY (series, resolution_s, start_s)
) WITHOUT ROWID;

-- What happened, each as the message that said it.
CREATE TABLE happened (
  structure TEXT NOT NULL,
  time_ns BIGINT NOT NULL,
  kind TEXT NOT NULL, -- alert, acknowledgement or event
  subject TEXT NOT NULL,
  state TEXT NOT NULL,
  message TEXT NOT NULL,
  PRIMARY KEY (structure, time_ns, kind, subject, state)
) WITHOUT ROWID;

-- How far each life of the service has come: a batch whose answer was lost is not written twice.
CREATE TABLE writer (
  id TEXT NOT NULL PRIMARY KEY,
  batch BIGINT NOT NULL
);

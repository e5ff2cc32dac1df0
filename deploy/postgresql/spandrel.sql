-- The database of the history, and connections with TLS 1.3 only that show a certificate of the site.
CREATE ROLE spandrel LOGIN;
CREATE DATABASE spandrel OWNER spandrel;
ALTER SYSTEM SET listen_addresses = 'localhost, 10.0.0.21';
ALTER SYSTEM SET ssl = on;
ALTER SYSTEM SET ssl_min_protocol_version = 'TLSv1.3';
ALTER SYSTEM SET ssl_ca_file = '/var/lib/postgresql/spandrel/authority.pem';
ALTER SYSTEM SET ssl_cert_file = '/var/lib/postgresql/spandrel/database.main.pem';
ALTER SYSTEM SET ssl_key_file = '/var/lib/postgresql/spandrel/database.main.key';

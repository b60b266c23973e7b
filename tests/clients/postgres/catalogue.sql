-- DBeaver: session +
select current_schema(), session_user
-- DBeaver: databases +
select db.oid, db.* from pg_catalog.pg_database db where datallowconn and not datistemplate or db.datname = current_database() order by db.datname
-- DBeaver: types +
select t.oid, t.*, c.relkind, format_type(nullif(t.typbasetype, 0), t.typtypmod) as base_type_name, d.description from pg_catalog.pg_type t left outer join pg_catalog.pg_type et on et.oid = t.typelem left outer join pg_catalog.pg_class c on c.oid = t.typrelid left outer join pg_catalog.pg_description d on t.oid = d.objoid where t.typname is not null and (c.relkind is null or c.relkind = 'c') and (et.typcategory is null or et.typcategory <> 'C')
-- DBeaver: schemas +
select n.oid, n.*, d.description from pg_catalog.pg_namespace n left outer join pg_catalog.pg_description d on d.objoid = n.oid and d.objsubid = 0 and d.classoid = 'pg_namespace'::regclass order by nspname
-- DBeaver: tables +
select c.oid, c.*, d.description, pg_catalog.pg_get_expr(c.relpartbound, c.oid) as partition_expr, pg_catalog.pg_get_partkeydef(c.oid) as partition_key from pg_catalog.pg_class c left outer join pg_catalog.pg_description d on d.objoid = c.oid and d.objsubid = 0 and d.classoid = 'pg_class'::regclass where c.relnamespace = {schema} and c.relkind not in ('i', 'I', 'c')
-- DBeaver: columns +
select c.relname, a.*, pg_catalog.pg_get_expr(ad.adbin, ad.adrelid, true) as def_value, dsc.description, dep.objid from pg_catalog.pg_attribute a inner join pg_catalog.pg_class c on (a.attrelid = c.oid) left outer join pg_catalog.pg_attrdef ad on (a.attrelid = ad.adrelid and a.attnum = ad.adnum) left outer join pg_catalog.pg_description dsc on (c.oid = dsc.objoid and a.attnum = dsc.objsubid) left outer join pg_depend dep on dep.refobjid = a.attrelid and dep.deptype = 'i' and dep.refobjsubid = a.attnum and dep.classid = dep.refclassid where not a.attisdropped and c.relkind not in ('i', 'I', 'c') and c.oid = {table} order by a.attnum
-- DBeaver: constraints
select c.oid, c.*, t.relname as tabrelname, rt.relnamespace as refnamespace, d.description, null as consrc_copy from pg_catalog.pg_constraint c inner join pg_catalog.pg_class t on t.oid = c.conrelid left outer join pg_catalog.pg_class rt on rt.oid = c.confrelid left outer join pg_catalog.pg_description d on d.objoid = c.oid and d.objsubid = 0 and d.classoid = 'pg_constraint'::regclass where c.conrelid = {table} order by c.oid
-- DBeaver: indexes
select i.*, i.indkey as keys, c.relname, c.relnamespace, c.relam, c.reltablespace, tc.relname as tabrelname, dsc.description, pg_catalog.pg_get_expr(i.indpred, i.indrelid) as pred_expr, pg_catalog.pg_get_expr(i.indexprs, i.indrelid, true) as expr, pg_catalog.pg_relation_size(i.indexrelid) as index_rel_size, pg_catalog.pg_stat_get_numscans(i.indexrelid) as index_num_scans from pg_catalog.pg_index i inner join pg_catalog.pg_class c on c.oid = i.indexrelid inner join pg_catalog.pg_class tc on tc.oid = i.indrelid left outer join pg_catalog.pg_description dsc on i.indexrelid = dsc.objoid where i.indrelid = {table} order by tabrelname, c.relname
-- DBeaver: triggers
select x.oid, x.*, p.pronamespace as func_schema_id, d.description from pg_catalog.pg_trigger x left outer join pg_catalog.pg_proc p on p.oid = x.tgfoid left outer join pg_catalog.pg_description d on d.objoid = x.oid and d.objsubid = 0 where x.tgrelid = {table} and not x.tgisinternal
-- DBeaver: dependencies
select distinct dep.deptype, dep.classid, dep.objid, cl.relkind, attr.attname, pg_get_expr(ad.adbin, ad.adrelid) adefval, case when cl.relkind is not null then cl.relkind::text || coalesce(dep.objsubid::text, '') when tg.oid is not null then 'T'::text else '' end as type, coalesce(coln.nspname, clsn.nspname) as nspname from pg_depend dep left join pg_class cl on dep.objid = cl.oid left join pg_attribute attr on dep.objid = attr.attrelid and dep.objsubid = attr.attnum left join pg_namespace clsn on cl.relnamespace = clsn.oid left join pg_trigger tg on dep.objid = tg.oid left join pg_namespace coln on clsn.oid = coln.oid left join pg_attrdef ad on ad.oid = dep.objid where dep.refobjid = {table} order by type
-- DBeaver: functions +
select p.oid as poid, p.*, pg_catalog.pg_get_expr(p.proargdefaults, 0) as arg_defaults, d.description from pg_catalog.pg_proc p left outer join pg_catalog.pg_description d on d.objoid = p.oid where p.pronamespace = (select oid from pg_namespace where nspname = 'pg_catalog') limit 20
-- DBeaver: roles +
select a.oid, a.*, pd.description from pg_catalog.pg_roles a left join pg_catalog.pg_shdescription pd on a.oid = pd.objoid order by a.rolname
-- DBeaver: settings +
select * from pg_catalog.pg_settings where name = 'standard_conforming_strings'
-- DBeaver: sizes +
select c.oid, pg_catalog.pg_total_relation_size(c.oid) as total_rel_size, pg_catalog.pg_relation_size(c.oid) as rel_size from pg_class c where c.relnamespace = {schema}
-- DBeaver: keywords +
select string_agg(word, ',') from pg_catalog.pg_get_keywords() where word <> all ('{a,abs,absolute,action,ada,add}'::text[])
-- DBeaver: extensions
select e.oid, e.*, n.nspname as schema_name from pg_catalog.pg_extension e join pg_catalog.pg_namespace n on n.oid = e.extnamespace where e.extname <> 'plpgsql'
-- DataGrip: server +
select version(), current_setting('server_version_num')::int, current_database(), pg_is_in_recovery()
-- DataGrip: databases +
select n.oid::bigint as id, datname as name, d.description, datistemplate as is_template, datallowconn as allow_connections, pg_catalog.pg_get_userbyid(n.datdba) as "owner" from pg_catalog.pg_database n left join pg_catalog.pg_shdescription d on n.oid = d.objoid order by case when datname = pg_catalog.current_database() then -1::bigint else n.oid::bigint end
-- DataGrip: schemas +
select n.oid::bigint as id, n.xmin as state_number, nspname as name, d.description, pg_catalog.pg_get_userbyid(n.nspowner) as "owner" from pg_catalog.pg_namespace n left join pg_catalog.pg_description d on n.oid = d.objoid order by case when nspname = pg_catalog.current_schema() then -1::bigint else n.oid::bigint end
-- DataGrip: tables +
select t.relkind as table_kind, t.relname as table_name, t.oid as table_id, t.xmin as table_state_number, t.reltablespace as tablespace_id, t.reloptions as options, t.relpersistence as persistence, (select pg_catalog.array_agg(inhparent::bigint order by inhseqno)::varchar from pg_catalog.pg_inherits where t.oid = inhrelid) as ancestors, (select pg_catalog.array_agg(inhrelid::bigint order by inhrelid)::varchar from pg_catalog.pg_inherits where t.oid = inhparent) as successors, t.relispartition as is_partition, pg_catalog.pg_get_partkeydef(t.oid) as partition_key, pg_catalog.pg_get_userbyid(t.relowner) as "owner" from pg_catalog.pg_class t where t.relnamespace = {schema}::oid and t.relkind in ('r', 'm', 'v', 'f', 'p') order by table_kind, table_id
-- DataGrip: columns +
with t as (select t.oid as table_id, t.relname as table_name from pg_catalog.pg_class t where t.relnamespace = {schema}::oid and t.relkind in ('r', 'm', 'v', 'f', 'p')) select t.table_id, c.attnum as column_position, c.attname as column_name, c.xmin as column_state_number, c.atttypmod as type_mod, c.attndims as dimensions_number, pg_catalog.format_type(c.atttypid, c.atttypmod) as type_spec, c.atttypid as type_id, c.attnotnull as mandatory, pg_catalog.pg_get_expr(d.adbin, t.table_id) as column_default_expression, not c.attislocal as column_is_inherited, c.attisdropped as column_is_dropped, c.attidentity as identity_kind, c.attgenerated as generated from t join pg_catalog.pg_attribute c on t.table_id = c.attrelid left join pg_catalog.pg_attrdef d on (c.attrelid, c.attnum) = (d.adrelid, d.adnum) where attnum > 0 order by table_id, attnum
-- DataGrip: comments
select d.objoid id, case when 'pg_catalog.pg_trigger'::regclass = classoid then 'T' when 'pg_catalog.pg_constraint'::regclass = classoid then 'C' else 'R' end as kind, d.objsubid sub_id, d.description from pg_catalog.pg_description d where d.classoid in ('pg_catalog.pg_class'::regclass, 'pg_catalog.pg_trigger'::regclass)
-- DataGrip: view sources
select t.relkind as view_kind, t.oid as view_id, pg_catalog.pg_get_viewdef(t.oid, true) as source_text from pg_catalog.pg_class t where t.relnamespace = {schema}::oid and t.relkind in ('v', 'm')
-- DataGrip: casts +
select c.oid as id, castsource as source_id, casttarget as target_id, castfunc as function_id, castcontext as context from pg_catalog.pg_cast c order by c.oid limit 9
-- Grafana: version +
select current_setting('server_version_num')::int / 100 as version
-- Grafana: extension
select extversion from pg_extension where extname = 'timescaledb'
-- Grafana: tables +
SELECT CASE WHEN quote_ident(table_schema) IN (
        SELECT
            CASE WHEN trim(s[i]) = '"$user"' THEN user ELSE trim(s[i]) END
        FROM
            generate_series(
                array_lower(string_to_array(current_setting('search_path'),','),1),
                array_upper(string_to_array(current_setting('search_path'),','),1)
            ) as i,
            string_to_array(current_setting('search_path'),',') s
      ) THEN quote_ident(table_name) ELSE quote_ident(table_schema) || '.' || quote_ident(table_name) END AS "table" FROM information_schema.tables WHERE quote_ident(table_schema) NOT IN ('information_schema', 'pg_catalog', '_timescaledb_cache', '_timescaledb_catalog') ORDER BY 1
-- Grafana: columns +
select quote_ident(column_name) as "column", data_type as "type" from information_schema.columns where quote_ident(table_name) = 'pairs'
-- Grafana: tables in order +
SELECT CASE WHEN quote_ident(table_schema) IN (
  SELECT CASE WHEN trim(s[i]) = '"$user"' THEN user ELSE trim(s[i]) END
  FROM generate_series(array_lower(string_to_array(current_setting('search_path'),','),1),
    array_upper(string_to_array(current_setting('search_path'),','),1)) as i,
    string_to_array(current_setting('search_path'),',') s) THEN quote_ident(table_name)
  ELSE quote_ident(table_schema) || '.' || quote_ident(table_name) END AS "table"
  FROM information_schema.tables WHERE quote_ident(table_schema) NOT IN ('information_schema', 'pg_catalog')
  ORDER BY CASE WHEN quote_ident(table_schema) IN (
  SELECT CASE WHEN trim(s[i]) = '"$user"' THEN user ELSE trim(s[i]) END
  FROM generate_series(array_lower(string_to_array(current_setting('search_path'),','),1),
    array_upper(string_to_array(current_setting('search_path'),','),1)) as i,
    string_to_array(current_setting('search_path'),',') s) THEN 0 ELSE 1 END, 1
-- Grafana: columns by parts of a name +
SELECT quote_ident(column_name) AS "column", data_type AS "type" FROM information_schema.columns
  WHERE CASE WHEN array_length(parse_ident('public.pairs'),1) = 2
  THEN quote_ident(table_schema) = (parse_ident('public.pairs'))[1]
    AND quote_ident(table_name) = (parse_ident('public.pairs'))[2]
  ELSE quote_ident(table_name) = 'public.pairs' AND quote_ident(table_schema) IN (
  SELECT CASE WHEN trim(s[i]) = '"$user"' THEN user ELSE trim(s[i]) END
  FROM generate_series(array_lower(string_to_array(current_setting('search_path'),','),1),
    array_upper(string_to_array(current_setting('search_path'),','),1)) as i,
    string_to_array(current_setting('search_path'),',') s) END
-- Grafana: a time series
select floor(extract(epoch from log_time) / 60) * 60 as "time", avg(snr_db) as "snr_db" from measurements where log_time between '2020-01-01T00:00:00Z' and '2100-01-01T00:00:00Z' group by 1 order by 1
-- Grafana: a logarithm of bounds
select 1 as a where extract(epoch from '2020-01-01T00:00:00Z'::timestamptz) < extract(epoch from now())
-- Metabase: time zone +
show timezone
-- Metabase: schemas +
select nspname from pg_namespace where nspname !~ '^pg_' and nspname not in ('information_schema')
-- Metabase: tables +
with table_privileges as (select null as role, t.schemaname as schema, t.objectname as table, pg_catalog.has_any_column_privilege(current_user, '"' || replace(t.schemaname, '"', '""') || '"' || '.' || '"' || replace(t.objectname, '"', '""') || '"', 'update') as update, pg_catalog.has_any_column_privilege(current_user, '"' || replace(t.schemaname, '"', '""') || '"' || '.' || '"' || replace(t.objectname, '"', '""') || '"', 'select') as select from (select schemaname, tablename as objectname from pg_catalog.pg_tables union select schemaname, viewname as objectname from pg_catalog.pg_views union select schemaname, matviewname as objectname from pg_catalog.pg_matviews) as t where t.schemaname !~ '^pg_' and t.schemaname <> 'information_schema' and pg_catalog.has_schema_privilege(current_user, t.schemaname, 'usage')) select t.* from table_privileges t
-- Metabase: kinds of tables +
select n.nspname as schema, c.relname as name, case c.relkind when 'r' then 'TABLE' when 'p' then 'PARTITIONED TABLE' when 'v' then 'VIEW' when 'f' then 'FOREIGN TABLE' when 'm' then 'MATERIALIZED VIEW' else null end as type, d.description as description, stat.n_live_tup as estimated_row_count from pg_catalog.pg_class as c inner join pg_catalog.pg_namespace as n on c.relnamespace = n.oid left join pg_catalog.pg_description as d on c.oid = d.objoid and d.objsubid = 0 and d.classoid = 'pg_class'::regclass left join pg_stat_user_tables as stat on n.nspname = stat.schemaname and c.relname = stat.relname where c.relnamespace = n.oid and n.nspname !~ 'information_schema' and c.relkind in ('r', 'p', 'v', 'f', 'm') and n.nspname in ('public') order by type asc, schema asc, name asc
-- Metabase: columns +
select c.column_name as name, case when c.udt_schema in ('public', 'pg_catalog') then format('%s', c.udt_name) else format('"%s"."%s"', c.udt_schema, c.udt_name) end as "database-type", c.ordinal_position - 1 as "database-position", c.table_schema as "table-schema", c.table_name as "table-name", pk.column_name is not null as "pk?", col_description(cast(cast(format('%I.%I', cast(c.table_schema as text), cast(c.table_name as text)) as regclass) as oid), c.ordinal_position) as "field-comment", (column_default is null or lower(column_default) = 'null') and is_nullable = 'NO' and not (column_default is not null and column_default like '%nextval(%') and is_identity = 'NO' as "database-required" from information_schema.columns as c left join (select tc.table_schema, tc.table_name, kc.column_name from information_schema.table_constraints as tc inner join information_schema.key_column_usage as kc on tc.constraint_name = kc.constraint_name and tc.table_schema = kc.table_schema and tc.table_name = kc.table_name where tc.constraint_type = 'PRIMARY KEY') as pk on c.table_schema = pk.table_schema and c.table_name = pk.table_name and c.column_name = pk.column_name where c.table_schema !~ '^information_schema|catalog_history|pg_' and c.table_schema in ('public') order by "table-schema", "table-name", "database-position"
-- Metabase: foreign keys
select fk_ns.nspname as "fk-table-schema", fk_table.relname as "fk-table-name", fk_column.attname as "fk-column-name", pk_ns.nspname as "pk-table-schema", pk_table.relname as "pk-table-name", pk_column.attname as "pk-column-name" from pg_constraint as c inner join pg_class as fk_table on c.conrelid = fk_table.oid inner join pg_namespace as fk_ns on c.connamespace = fk_ns.oid inner join pg_attribute as fk_column on c.conrelid = fk_column.attrelid inner join pg_class as pk_table on c.confrelid = pk_table.oid inner join pg_namespace as pk_ns on pk_table.relnamespace = pk_ns.oid inner join pg_attribute as pk_column on c.confrelid = pk_column.attrelid where fk_ns.nspname !~ '^information_schema$|^pg_' and c.contype = 'f'::char and fk_column.attnum = any(c.conkey) and pk_column.attnum = any(c.confkey) order by 1, 2
-- Metabase: enums
select nspname, typname from pg_type t left join pg_namespace n on n.oid = t.typnamespace where t.oid in (select distinct e.enumtypid from pg_enum e)
-- Metabase: a day's mean
select date_trunc('day', log_time) as day, avg(snr_db) as mean from measurements group by date_trunc('day', log_time) order by date_trunc('day', log_time) asc
-- Superset: schemas +
select nspname from pg_namespace where nspname not like 'pg/_%' escape '/' order by nspname
-- Superset: tables +
select pg_catalog.pg_class.relname from pg_catalog.pg_class join pg_catalog.pg_namespace on pg_catalog.pg_namespace.oid = pg_catalog.pg_class.relnamespace where pg_catalog.pg_class.relkind = any (array['r', 'p']) and pg_catalog.pg_class.relpersistence != 't' and pg_catalog.pg_table_is_visible(pg_catalog.pg_class.oid) and pg_catalog.pg_namespace.nspname != 'pg_catalog'
-- Superset: views +
select pg_catalog.pg_class.relname from pg_catalog.pg_class join pg_catalog.pg_namespace on pg_catalog.pg_namespace.oid = pg_catalog.pg_class.relnamespace where pg_catalog.pg_class.relkind = any (array['v']) and pg_catalog.pg_namespace.nspname = 'public'
-- Superset: time grain
select date_trunc('hour', log_time) as __timestamp, count(*) as count from measurements where log_time >= to_timestamp('2020-01-01 00:00:00.000000', 'YYYY-MM-DD HH24:MI:SS.US') group by date_trunc('hour', log_time) order by count desc limit 100
-- Superset: catalogues +
select datname from pg_database where not datistemplate
-- Tableau: tables +
select n.nspname as table_schem, c.relname as table_name, c.relkind from pg_catalog.pg_class c, pg_catalog.pg_namespace n where n.oid = c.relnamespace and c.relkind in ('r', 'v', 'm', 'f', 'p') and n.nspname not in ('pg_catalog', 'information_schema', 'pg_toast', 'pg_temp_1') order by nspname, relname
-- Tableau: columns +
select n.nspname, c.relname, a.attname, a.atttypid, t.typname, a.attnum, a.attlen, a.atttypmod, a.attnotnull, c.relhasrules, c.relkind, c.oid, pg_get_expr(d.adbin, d.adrelid), case t.typtype when 'd' then t.typbasetype else 0 end, t.typtypmod, c.relhasoids from (((pg_catalog.pg_class c inner join pg_catalog.pg_namespace n on n.oid = c.relnamespace and c.oid = {table}) inner join pg_catalog.pg_attribute a on (not a.attisdropped) and a.attnum > 0 and a.attrelid = c.oid) inner join pg_catalog.pg_type t on t.oid = a.atttypid) left outer join pg_attrdef d on a.atthasdef and d.adrelid = a.attrelid and d.adnum = a.attnum order by n.nspname, c.relname, attnum
-- Tableau: keys
select ta.attname, ia.attnum, ic.relname, n.nspname, tc.relname from pg_catalog.pg_attribute ta, pg_catalog.pg_attribute ia, pg_catalog.pg_class tc, pg_catalog.pg_index i, pg_catalog.pg_namespace n, pg_catalog.pg_class ic where tc.oid = {table} and tc.oid = i.indrelid and n.oid = tc.relnamespace and i.indisprimary = 't' and ia.attrelid = i.indexrelid and ta.attrelid = i.indrelid and ta.attnum = i.indkey[ia.attnum - 1] and (not ta.attisdropped) and (not ia.attisdropped) and ic.oid = i.indexrelid order by ia.attnum
-- Tableau: foreign keys
select 'lake'::name as "PKTABLE_CAT", n2.nspname as "PKTABLE_SCHEM", c2.relname as "PKTABLE_NAME", a2.attname as "PKCOLUMN_NAME", ref.i as "KEY_SEQ" from ((((((( (select cn.oid, conrelid, conkey, confrelid, confkey, generate_series(array_lower(conkey, 1), array_upper(conkey, 1)) as i, confupdtype, confdeltype, conname, condeferrable, condeferred from pg_catalog.pg_constraint cn where contype = 'f') ref inner join pg_catalog.pg_class c1 on c1.oid = ref.conrelid) inner join pg_catalog.pg_namespace n1 on n1.oid = c1.relnamespace) inner join pg_catalog.pg_attribute a1 on a1.attrelid = c1.oid and a1.attnum = conkey[i]) inner join pg_catalog.pg_class c2 on c2.oid = ref.confrelid) inner join pg_catalog.pg_namespace n2 on n2.oid = c2.relnamespace) inner join pg_catalog.pg_attribute a2 on a2.attrelid = c2.oid and a2.attnum = confkey[i])) order by ref.oid, ref.i
-- Tableau: an extract +
select "pairs"."pair_id" as "pair_id", cast("pairs"."direct_mm" as text) as "direct", sum("pairs"."direct_mm") as "sum:direct_mm:ok" from "public"."pairs" "pairs" group by 1, 2 limit 10
-- Tableau: a date +
select cast(trunc(extract(year from "measurements"."log_time")) as integer) as "yr:log_time:ok" from "public"."measurements" "measurements" group by 1
-- Npgsql: version +
select version()
-- Npgsql: types +
select ns.nspname, t.oid, t.typname, t.typtype, t.typnotnull, t.elemtypoid from (select typ.oid, typ.typnamespace, typ.typname, typ.typtype, typ.typrelid, typ.typnotnull, typ.relkind, elemtyp.oid as elemtypoid, elemtyp.typname as elemtypname, elemcls.relkind as elemrelkind, case when elemproc.proname = 'array_recv' then 'a' else elemtyp.typtype end as elemtyptype from (select typ.oid, typnamespace, typname, typrelid, typnotnull, relkind, typelem as elemoid, case when proc.proname = 'array_recv' then 'a' else typ.typtype end as typtype, case when proc.proname = 'array_recv' then typ.typelem when typ.typtype = 'r' then rngsubtype when typ.typtype = 'd' then typ.typbasetype end as elemtypoid from pg_type as typ left join pg_class as cls on (cls.oid = typ.typrelid) left join pg_proc as proc on proc.oid = typ.typreceive left join pg_range on (pg_range.rngtypid = typ.oid)) as typ left join pg_type as elemtyp on elemtyp.oid = elemtypoid left join pg_class as elemcls on (elemcls.oid = elemtyp.typrelid) left join pg_proc as elemproc on elemproc.oid = elemtyp.typreceive) as t join pg_namespace as ns on (ns.oid = typnamespace) where typtype in ('b', 'r', 'm', 'e', 'd') or (typtype = 'c' and relkind = 'c') or (typtype = 'p' and typname in ('record', 'void')) or (typtype = 'a' and (elemtyptype in ('b', 'r', 'm', 'e', 'd') or (elemtyptype = 'p' and elemtypname in ('record', 'void')) or (elemtyptype = 'c' and elemrelkind = 'c'))) order by case when typtype in ('b', 'e', 'p') then 0 when typtype = 'c' then 1 when typtype = 'r' then 2 when typtype = 'm' then 3 when typtype = 'd' and elemtyptype <> 'a' then 4 when typtype = 'a' then 5 when typtype = 'd' and elemtyptype = 'a' then 6 end
-- Npgsql: arrays are found +
select typ.typname from pg_type typ join pg_proc proc on proc.oid = typ.typreceive where proc.proname = 'array_recv' and typ.typname = '_float4'
-- Npgsql: composite types
select typ.oid, att.attname, att.atttypid from pg_type as typ join pg_namespace as ns on (ns.oid = typ.typnamespace) join pg_class as cls on (cls.oid = typ.typrelid) join pg_attribute as att on (att.attrelid = typ.typrelid) where (typ.typtype = 'c' and cls.relkind = 'c') and attnum > 0 and not attisdropped order by typ.oid, att.attnum
-- Npgsql: enums
select pg_type.oid, enumlabel from pg_enum join pg_type on pg_type.oid = enumtypid order by oid, enumsortorder
-- Npgsql: reset
discard all
-- Npgsql: columns of an answer +
select attr.oid, attr.attname, attr.attnum, typ.typname, attr.attnotnull, attr.attidentity != '' as isidentity from (select cls.oid as oid, a.* from pg_attribute a join pg_class cls on cls.oid = a.attrelid) attr join pg_type typ on typ.oid = attr.atttypid where attr.attrelid = {table} and attr.attnum in (1, 2)
-- Power BI: tables +
select table_schema, table_name, table_type from information_schema.tables where table_schema not in ('information_schema', 'pg_catalog') order by table_schema, table_name
-- Power BI: character sets +
select character_set_name from information_schema.character_sets
-- Power BI: columns +
select column_name, ordinal_position, is_nullable, case when (data_type like '%unsigned%') then data_type || ' unsigned' else data_type end as data_type from information_schema.columns where table_schema = 'public' and table_name = 'pairs' order by table_schema, table_name, ordinal_position
-- Power BI: keys
select i.constraint_schema || '_' || i.constraint_name as index_name, ii.column_name, ii.ordinal_position, case when i.constraint_type = 'PRIMARY KEY' then 'Y' else 'N' end as primary_key from information_schema.table_constraints i inner join information_schema.key_column_usage ii on i.constraint_schema = ii.constraint_schema and i.constraint_name = ii.constraint_name and i.table_schema = ii.table_schema and i.table_name = ii.table_name where i.table_schema = 'public' and i.table_name = 'pairs' and i.constraint_type in ('PRIMARY KEY', 'UNIQUE')
-- Power BI: foreign keys
select pkcol.column_name as pk_column_name, fkcol.table_schema as fk_table_schema, fkcol.table_name as fk_table_name, fkcol.column_name as fk_column_name, fkcol.ordinal_position as ordinal, fkcon.constraint_schema || '_' || fkcol.table_name || '_' || 'pairs' || '_' || fkcon.constraint_name as fk_name from (select distinct constraint_catalog, constraint_schema, unique_constraint_schema, constraint_name, unique_constraint_name from information_schema.referential_constraints) fkcon inner join information_schema.key_column_usage fkcol on fkcon.constraint_schema = fkcol.constraint_schema and fkcon.constraint_name = fkcol.constraint_name inner join information_schema.key_column_usage pkcol on fkcon.unique_constraint_schema = pkcol.constraint_schema and fkcon.unique_constraint_name = pkcol.constraint_name where pkcol.table_schema = 'public' and pkcol.table_name = 'pairs' and pkcol.ordinal_position = fkcol.ordinal_position order by fk_name, fkcol.ordinal_position
-- Power BI: a folded query +
select "_"."pair_id" as "pair_id", "_"."direct_mm" as "direct_mm" from (select "pair_id", "direct_mm" from "public"."pairs" "$Table") "_" where "_"."pair_id" >= 3 and "_"."pair_id" < 9 limit 200
-- Rails, Prisma: tables +
select tbl.relname as table_name, namespace.nspname as namespace, (tbl.relhassubclass and tbl.relkind = 'p') as is_partition, tbl.relrowsecurity as has_row_level_security, obj_description(tbl.oid, 'pg_class') as description from pg_class as tbl inner join pg_namespace as namespace on namespace.oid = tbl.relnamespace where (tbl.relkind = 'r' or tbl.relkind = 'p') and namespace.nspname = any (array['public']) order by namespace, table_name
-- Rails: columns +
select a.attname, format_type(a.atttypid, a.atttypmod), pg_get_expr(d.adbin, d.adrelid), a.attnotnull, a.atttypid, a.atttypmod, c.collname, col_description(a.attrelid, a.attnum) as comment, attidentity as identity, attgenerated as attgenerated from pg_attribute a left join pg_attrdef d on a.attrelid = d.adrelid and a.attnum = d.adnum left join pg_type t on a.atttypid = t.oid left join pg_collation c on a.attcollation = c.oid and a.attcollation <> t.typcollation where a.attrelid = '"pairs"'::regclass and a.attnum > 0 and not a.attisdropped order by a.attnum
-- Rails: primary keys
select a.attname from (select indrelid, indkey, generate_subscripts(indkey, 1) idx from pg_index where indrelid = '"pairs"'::regclass and indisprimary) i join pg_attribute a on a.attrelid = i.indrelid and a.attnum = i.indkey[i.idx] order by i.idx
-- Rails: types +
select t.oid, t.typname, t.typelem, t.typdelim, t.typinput, r.rngsubtype, t.typtype, t.typbasetype from pg_type as t left join pg_range as r on oid = rngtypid where t.typname in ('int2', 'int4', 'int8', 'oid', 'float4', 'float8', 'numeric', 'bool')
-- Rails: types by input +
select t.oid, t.typname, t.typelem, t.typdelim, t.typinput::varchar from pg_type as t where t.typinput = 'array_in(cstring,oid,integer)'::regprocedure
-- Django: tables +
select c.relname, case when c.relispartition then 'p' when c.relkind in ('m', 'v') then 'v' else 't' end, obj_description(c.oid, 'pg_class') from pg_catalog.pg_class c left join pg_catalog.pg_namespace n on n.oid = c.relnamespace where c.relkind in ('f', 'm', 'p', 'r', 'v') and n.nspname not in ('pg_catalog', 'pg_toast') and pg_catalog.pg_table_is_visible(c.oid)
-- Django: columns +
select a.attname as column_name, not (a.attnotnull or (t.typtype = 'd' and t.typnotnull)) as is_nullable, pg_get_expr(ad.adbin, ad.adrelid) as column_default, case when collname = 'default' then null else collname end as collation, a.attidentity != '' as is_autofield, col_description(a.attrelid, a.attnum) as column_comment from pg_attribute a left join pg_attrdef ad on a.attrelid = ad.adrelid and a.attnum = ad.adnum left join pg_collation co on a.attcollation = co.oid join pg_type t on a.atttypid = t.oid join pg_class c on a.attrelid = c.oid join pg_namespace n on c.relnamespace = n.oid where c.relkind in ('f', 'm', 'p', 'r', 'v') and c.relname = 'pairs' and n.nspname not in ('pg_catalog', 'pg_toast') and pg_catalog.pg_table_is_visible(c.oid)
-- Django: constraints
select c.conname, array(select attname from unnest(c.conkey) with ordinality cols(colid, arridx) join pg_attribute as ca on cols.colid = ca.attnum where ca.attrelid = c.conrelid order by cols.arridx), c.contype, (select fkc.relname || '.' || fka.attname from pg_attribute as fka join pg_class as fkc on fka.attrelid = fkc.oid where fka.attrelid = c.confrelid and fka.attnum = c.confkey[1]), cl.reloptions from pg_constraint as c join pg_class as cl on c.conrelid = cl.oid where cl.relname = 'pairs' and pg_catalog.pg_table_is_visible(cl.oid)
-- R RPostgres: tables +
select table_name from information_schema.tables where table_schema = any(current_schemas(true)) and table_schema <> 'pg_catalog'
-- R RPostgres: types +
select oid, typname from pg_type
-- sqlx: types +
select oid::int8, typname, typelem::int8 from pg_catalog.pg_type where oid = 1021
-- sqlx: nullability +
select not attnotnull from pg_catalog.pg_attribute where attrelid = {table}::int8 and attnum = 1
-- FDW: columns +
select relname, attname, format_type(atttypid, atttypmod), attnotnull, pg_get_expr(adbin, adrelid), attgenerated, collname, collnsp.nspname from pg_class c join pg_namespace n on relnamespace = n.oid left join pg_attribute a on attrelid = c.oid and attnum > 0 and not attisdropped left join pg_attrdef ad on adrelid = c.oid and adnum = attnum left join pg_collation coll on coll.oid = attcollation left join pg_namespace collnsp on collnsp.oid = collnamespace where c.relkind in ('r', 'v', 'f', 'm', 'p') and n.nspname = 'public' and (not c.relispartition or c.relkind = 'p') order by c.relname, attnum
-- pgAdmin: first statement +
SELECT set_config('bytea_output','hex',false) FROM pg_show_all_settings() WHERE name = 'bytea_output'
-- pgAdmin: session +
select db.oid as did, db.datname, db.datallowconn, pg_catalog.pg_encoding_to_char(db.encoding) as serverencoding, has_database_privilege(db.oid, 'CREATE') as cancreate, datistemplate from pg_catalog.pg_database db where db.datname = current_database()
-- pgAdmin: role +
select roles.oid as id, roles.rolname as name, roles.rolsuper as is_superuser, case when roles.rolsuper then true else roles.rolcreaterole end as can_create_role from pg_catalog.pg_roles as roles where rolname = current_user
-- pgAdmin: tables +
select rel.oid, rel.relname as name, (select count(*) from pg_catalog.pg_trigger where tgrelid = rel.oid and tgisinternal = false) as triggercount, (select count(1) from pg_catalog.pg_inherits where inhrelid = rel.oid limit 1) as is_inherits, des.description from pg_catalog.pg_class rel left join pg_catalog.pg_description des on (des.objoid = rel.oid and des.objsubid = 0 and des.classoid = 'pg_class'::regclass) where rel.relkind in ('r', 's', 't', 'p') and rel.relnamespace = {schema}::oid and not rel.relispartition order by rel.relname
-- pgAdmin: has a key +
select c.relname, exists(select 1 from pg_catalog.pg_constraint k where k.conrelid = c.oid and k.contype = 'p') as has_key from pg_catalog.pg_class c where c.relnamespace = {schema}
-- Looker, dbt: relations +
select 'lake' as database, tablename as name, schemaname as schema, 'table' as type from pg_tables where schemaname ilike 'public' union all select 'lake' as database, viewname as name, schemaname as schema, 'view' as type from pg_views where schemaname ilike 'public'
-- dbt: columns +
select column_name, data_type, character_maximum_length, numeric_precision, numeric_scale from information_schema.columns where table_name = 'pairs' and table_schema = 'public' order by ordinal_position
-- ODBC: privileges
select relname, usename, relacl from pg_catalog.pg_namespace n, pg_catalog.pg_class c, pg_catalog.pg_user u where relname = 'pairs' and u.usesysid = c.relowner and n.oid = c.relnamespace
-- Monitoring: activity +
select pid, usename, state from pg_stat_activity where pid = pg_backend_pid()
-- Monitoring: sizes +
select relname, pg_size_pretty(pg_total_relation_size(oid)) from pg_class where relkind = 'r'
-- Privileges that write +
select 1 where not has_table_privilege('public.pairs', 'INSERT') or current_setting('is_superuser') = 'on'
-- Physical row +
select c.tableoid from pg_class c limit 1
-- Generated subscripts +
select generate_subscripts(array[4, 5, 6], 1) as i
-- Types of columns +
select udt_schema, udt_name, is_identity, is_generated, is_updatable from information_schema.columns where table_name = 'measurements' and column_name = 'ir' and udt_name = '_float4'
-- Information schema: constraints
select * from information_schema.table_constraints
-- Information schema: key columns
select * from information_schema.key_column_usage
-- Information schema: constrained columns
select * from information_schema.constraint_column_usage
-- Information schema: check constraints
select constraint_name, check_clause from information_schema.check_constraints
-- Information schema: privileges
select grantee, privilege_type from information_schema.table_privileges
-- Information schema: views +
select table_name, view_definition, is_updatable from information_schema.views where table_schema = 'public'
-- Information schema: sequences
select sequence_name from information_schema.sequences
-- Information schema: triggers
select trigger_name from information_schema.triggers
-- Information schema: domains
select domain_name from information_schema.domains
-- Information schema: element types
select object_name, data_type from information_schema.element_types
